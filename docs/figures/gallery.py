"""Run the pages of docs/gallery, check what they print, and draw their pictures.

python docs/figures/gallery.py [NAME...]

A page has Python examples, as in an interactive session, and ``console`` blocks with `wpdc`
commands.  They run in the order of the page, in an empty folder.  The picture of a page is the
figure that it names ``figure``, or the file ``picture.png``.
"""

import argparse
import contextlib
import doctest
import io
import logging
import os
import re
import shlex
import sys
import tempfile
import textwrap
import warnings
from pathlib import Path

from PIL import Image
from pytest_doctestplus.output_checker import FLOAT_CMP, OutputChecker

from wpdc_gwcs.cli.app import run as run_wpdc

DOCS = Path(__file__).resolve().parent.parent
FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS | FLOAT_CMP


def page_names():
    """Names of the pages, without the table of contents."""
    return sorted(p.stem for p in (DOCS / "gallery").glob("*.rst") if p.stem != "index")


def console_examples(text):
    """Commands of the ``console`` blocks of a page, each with what it should print."""
    block = re.compile(r"^\.\. code-block:: console\n\n((?:   .*\n|\n)+)", re.M)
    for found in block.finditer(text):
        line = text.count("\n", 0, found.start(1))
        for command, want in re.findall(
            r"^\$ (.*\n)((?:(?!\$ ).*\n)*)", textwrap.dedent(found[1]), re.M
        ):
            want = want.rstrip("\n") + "\n" if want.strip() else ""
            yield doctest.Example(f"_wpdc({command.strip()!r})\n", want, lineno=line)


def wpdc(command):
    """Run a `wpdc` command and print what it says, wherever it says it."""
    program, *arguments = shlex.split(command)
    if program != "wpdc":
        raise ValueError(f"only wpdc commands can be run, got {command!r}")
    logger = logging.getLogger("wpdc_gwcs")
    before = logger.handlers, logger.propagate, logger.level
    said = io.StringIO()
    try:
        with warnings.catch_warnings(), contextlib.redirect_stderr(said):
            with contextlib.redirect_stdout(said):
                run_wpdc(arguments)
    finally:
        logger.handlers, logger.propagate = before[:2]
        logger.setLevel(before[2])
    print(said.getvalue(), end="")


def run_page(name, folder):
    """Run a page in a folder; return its variables and a report of what differs from the page."""
    return run_text(name, (DOCS / "gallery" / f"{name}.rst").read_text(encoding="utf-8"), folder)


def run_text(name, text, folder):
    """Run the text of a page."""
    examples = [*doctest.DocTestParser().get_examples(text), *console_examples(text)]
    examples.sort(key=lambda example: example.lineno)
    names = {"_wpdc": wpdc}
    page = doctest.DocTest(examples, names, name, f"{name}.rst", 0, text)
    runner = doctest.DocTestRunner(OutputChecker(), verbose=False, optionflags=FLAGS)
    report = io.StringIO()
    home = Path.cwd()
    os.chdir(folder)
    try:
        runner.run(page, out=report.write, clear_globs=False)
    finally:
        os.chdir(home)
    return page.globs, report.getvalue()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="pages; all by default")
    for name in parser.parse_args().names or page_names():
        picture = DOCS / "images" / f"gallery_{name}.png"
        with tempfile.TemporaryDirectory() as folder:
            made, report = run_page(name, folder)
            if report:
                sys.exit(report)
            drawn = Path(folder) / "picture.png"
            if "figure" in made:
                made["figure"].savefig(drawn, dpi=80)
            # A noisy sky in all its shades would be three times as large.
            Image.open(drawn).convert("RGB").quantize(64).save(picture, optimize=True)
        print(name, flush=True)


if __name__ == "__main__":
    main()
