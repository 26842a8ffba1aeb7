"""The layout of the package, drawn from the import contract in pyproject.toml.

``python docs/figures/layout.py`` puts it into CONTRIBUTING.rst.  The purpose of a module is the
first sentence of its docstring: the picture says nothing that the code does not say.
"""

import ast
import re
import textwrap
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
PAGE = ROOT / "CONTRIBUTING.rst"
# Where the picture stands in the page.
_BLOCK = re.compile(r"(?<=^\.\. layout: begin\n\n).*?(?=^\.\. layout: end$)", re.M | re.S)
_WIDTH = 92


def layers():
    """Modules by layer, top first, without the name of the package."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    layered = next(c for c in contracts if c["type"] == "layers")
    return [re.findall(r"wpdc_gwcs\.(\w+)", layer) for layer in layered["layers"]]


def purpose(module):
    """First sentence of the docstring of a module, without markup."""
    path = ROOT / "wpdc_gwcs" / module
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return docstring.split("\n\n")[0].replace("\n", " ").replace("`", "").rstrip(".")


def draw():
    """Literal block of reStructuredText with one box for each layer."""
    width = max(len(module) for layer in layers() for module in layer)
    rule = "+" + "-" * (_WIDTH - 2) + "+"
    lines = [rule]
    for layer in layers():
        for module in layer:
            texts = textwrap.wrap(purpose(module), _WIDTH - width - 7) or [""]
            for name, text in zip([module] + [""] * (len(texts) - 1), texts, strict=True):
                lines.append(f"| {name:{width}}  {text}".ljust(_WIDTH - 1) + "|")
        lines.append(rule)
    return "::\n\n" + "".join(f"   {line}\n" for line in lines) + "\n"


def main():
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(_BLOCK.sub(lambda _: draw(), page), encoding="utf-8")


if __name__ == "__main__":
    main()
