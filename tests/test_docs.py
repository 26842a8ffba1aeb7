"""The reference pages say what the program does: every command, option, default and name."""

import ast
import importlib
import inspect
import re
import runpy
import shlex
import textwrap
from pathlib import Path

import pytest
import typer

import wpdc_gwcs
from wpdc_gwcs import detection
from wpdc_gwcs.calibration import Settings
from wpdc_gwcs.cli import app

DOCS = Path(__file__).resolve().parent.parent / "docs"


def commands_of(group, name=""):
    """Commands by name, those of groups by both names."""
    if not hasattr(group, "commands"):
        return {name: group}
    found = (commands_of(c, f"{name} {n}".strip()) for n, c in group.commands.items())
    return {n: c for commands in found for n, c in commands.items()}


COMMANDS = commands_of(typer.main.get_command(app))


def read_page(name):
    return (DOCS / name).read_text(encoding="utf-8")


def cli_sections():
    """Text of the page by command."""
    parts = re.split(r"^\.\. program:: wpdc (.+)$", read_page("reference/cli.rst"), flags=re.M)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def documented_options(section):
    """Text of every ``.. option::`` of a section by its line of names."""
    parts = re.split(r"^\.\. option:: (.+)$", section, flags=re.M)
    # The text of an option ends where its indentation does.
    texts = (re.match(r"\n(?:\n|   .*\n?)*", text)[0] for text in parts[2::2])
    return {names: " ".join(text.split()) for names, text in zip(parts[1::2], texts, strict=True)}


def is_option(parameter):
    return parameter.opts[0].startswith("-")


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_ends_with_an_example_that_parses(name):
    command, epilog = COMMANDS[name], COMMANDS[name].epilog
    start = f"Example: wpdc {name} "
    assert epilog.startswith(start)
    context = command.make_context(name, shlex.split(epilog.removeprefix(start)))
    assert context.params
    first = command.help.split("\n\n")[0].rstrip(".")
    assert len(first) <= 62, "longer ones are cut off in the list of commands"


def test_every_command_is_documented():
    assert sorted(cli_sections()) == sorted(COMMANDS)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_every_option_is_documented(name):
    expected = {
        ", ".join(f"{o} {p.metavar}" if p.metavar else o for o in p.opts)
        for p in COMMANDS[name].params
        if is_option(p)
    }
    assert set(documented_options(cli_sections()[name])) == expected


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_documented_defaults_are_those_of_the_program(name):
    texts = documented_options(cli_sections()[name])
    for parameter in filter(is_option, COMMANDS[name].params):
        text = next(
            t for names, t in texts.items() if parameter.opts[0] in re.split(r"[ ,]+", names)
        )
        takes_value = parameter.metavar is not None
        if parameter.required:
            assert text.endswith("Required."), parameter.name
        elif takes_value and parameter.default is not None:
            assert text.endswith(f"Default: ``{parameter.default}``."), parameter.name
        else:
            assert "Default: ``" not in text, parameter.name


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_arguments_are_documented(name):
    section = cli_sections()[name]
    for parameter in COMMANDS[name].params:
        if not is_option(parameter):
            metavar = re.escape(parameter.metavar.removesuffix("..."))
            assert re.search(rf"^``{metavar}(\.\.\.)?``$", section, flags=re.M)


def test_exit_statuses_are_documented():
    section = read_page("reference/cli.rst").split("Exit status\n", 1)[1]
    table = section.split("wpdc calibrate\n", 1)[0]
    assert re.findall(r"^(\d+) ", table, flags=re.M) == ["0", "1", "2", "130"]


def test_every_public_name_is_in_the_api_page():
    page = read_page("reference/api.rst")
    for name in wpdc_gwcs.__all__:
        if not name.startswith("_"):
            assert re.search(rf"`~wpdc_gwcs\.[\w.]+\.{name}`", page), name


def public_objects():
    """Functions and classes of the modules of the API page, by name."""
    for module in re.findall(r"automodapi:: ([\w.]+)", read_page("reference/api.rst")):
        loaded = importlib.import_module(module)
        for name in loaded.__all__:
            found = getattr(loaded, name)
            if inspect.isclass(found) or inspect.isfunction(found):
                yield f"{module}.{name}", found


def test_every_public_function_and_class_has_an_example_that_runs():
    def has_example(found):
        lines = [line for line in inspect.getdoc(found).splitlines() if ">>>" in line]
        return any("import" not in line and "+SKIP" not in line for line in lines)

    objects = dict(public_objects())
    assert len(objects) > 150
    # A HATS catalog is a folder of Parquet files, which are made with an optional package.
    without = [name for name, found in objects.items() if not has_example(found)]
    assert without == ["wpdc_gwcs.catalogs.HatsCatalog"]


@pytest.fixture(scope="module")
def run():
    simulation = wpdc_gwcs.simulate(1, image_shape=(512, 512), density=100.0, distortion=5.0)
    catalog = wpdc_gwcs.read_catalog(simulation.reference)
    frame = simulation.exposures[0].frame(image=True)
    return wpdc_gwcs.calibrate(frame, catalog, settings=Settings(holdout=0.2, lut="none"))


def documented_columns(title):
    """Names in the first column of the first table below a title of the page of files."""
    rows = read_page("reference/files.rst").split(f"\n{title}\n", 1)[1].split("\n\n", 2)[1]
    return [name for row in rows.splitlines() for name in re.findall(r"``(\w+)``", row[:44])]


def test_columns_are_documented(run):
    calibration = run.calibrations[0]
    assert documented_columns("Matches, ``STEM.matches.ecsv``") == calibration.matches.colnames
    assert documented_columns("Sources, ``STEM.sources.ecsv``") == calibration.sources.colnames
    assert documented_columns("Summary, ``summary.ecsv``") == run.summary.colnames


def test_flags_are_documented():
    page = read_page("reference/files.rst")
    documented = {n: int(v) for v, n in re.findall(r"^(\d+) +``(FLAG_\w+)``", page, flags=re.M)}
    assert documented == {n: getattr(detection, n) for n in dir(detection) if n.startswith("FLAG_")}


def test_layout_is_that_of_the_import_contract():
    layout = runpy.run_path(str(DOCS / "figures" / "layout.py"))
    page = (DOCS.parent / "CONTRIBUTING.rst").read_text(encoding="utf-8")
    assert layout["draw"]() in page, "run: python docs/figures/layout.py"
    modules = {m for layer in layout["layers"]() for m in layer}
    package = DOCS.parent / "wpdc_gwcs"
    assert all((package / m).is_dir() or (package / f"{m}.py").is_file() for m in modules)


PAGES = [
    page
    for page in (
        *sorted(DOCS.rglob("*.rst")),
        DOCS.parent / "README.rst",
        DOCS.parent / "CHANGES.rst",
    )
    if not {"_build", "api"} & set(page.relative_to(DOCS.parent).parts)
]


def literal_blocks(page, opening):
    """Dedented text of the blocks that begin with a line like this."""
    text = page.read_text(encoding="utf-8")
    for found in re.finditer(rf"^( *).*{opening}\n\n((?:\1 +.*\n|\n)+)", text, re.M):
        yield textwrap.dedent(found[2])


def python_blocks():
    """Code that is shown but not run: what reads files that are not there."""
    for page in PAGES:
        for block in literal_blocks(page, r"\.\. code-block:: python"):
            yield pytest.param(block, id=f"{page.stem}-{block.split()[-1][:20]}")


@pytest.mark.parametrize("code", list(python_blocks()))
def test_code_that_is_not_run_has_names_that_exist(code):
    tree = ast.parse(code)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("wpdc_gwcs"):
            module = importlib.import_module(node.module)
            assert [a.name for a in node.names if not hasattr(module, a.name)] == []
    # Keyword arguments of functions that were imported must be theirs.
    names = {a.name for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for a in n.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in names:
            function = getattr(wpdc_gwcs, node.func.id, None)
            if function is not None:
                parameters = inspect.signature(function).parameters
                assert [k.arg for k in node.keywords if k.arg not in parameters] == []


def shown_commands():
    """Command lines of `wpdc` on all pages, without what stands for something else."""
    for page in PAGES:
        text = "".join(
            block
            for opening in (r"::", r"\.\. code-block:: (?:console|text|bash)")
            for block in literal_blocks(page, opening)
        )
        text = re.sub(r" \\\n\s*", " ", text)
        for line in re.findall(r"^(?:\$ )?(wpdc [a-z].*)$", text, re.M):
            command = line.split(";")[0].strip()
            if not re.search(r"\.\.\.|[{(\[]|--version", command):
                yield pytest.param(command, id=f"{page.stem}: {command}")


@pytest.mark.parametrize("line", list(shown_commands()))
def test_shown_commands_are_understood(line):
    words = shlex.split(line)[1:]
    name = max((n for n in COMMANDS if words[: len(n.split())] == n.split()), key=len)
    command, words = COMMANDS[name], words[len(name.split()) :]
    known = {option: p for p in command.params for option in p.opts + p.secondary_opts}
    given = [word for word in words if re.match(r"--?[a-z]", word)]
    assert [option for option in given if option not in known] == []
    required = {p.opts[0] for p in command.params if is_option(p) and p.required}
    assert required <= set(given)
