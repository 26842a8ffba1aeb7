import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import wpdc_gwcs

HEAVY = ["photutils", "matplotlib", "dask", "lsdb", "astroquery", "sep", "scipy", "gwcs", "typer"]


def run(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_import_is_light():
    # asdf imports the package for every file that it opens, whatever is in the file.
    loaded = run("import sys, wpdc_gwcs; print(*{m.partition('.')[0] for m in sys.modules})")
    assert not set(HEAVY) & set(loaded)


@pytest.mark.parametrize("module", ["models", "wcs", "solution", "simulation", "plotting"])
def test_modules_leave_the_extras_alone(module):
    loaded = run(
        f"import sys, wpdc_gwcs.{module}; print(*{{m.partition('.')[0] for m in sys.modules}})"
    )
    assert not {"photutils", "matplotlib", "dask", "lsdb", "astroquery"} & set(loaded)


@pytest.mark.parametrize("name", wpdc_gwcs.__all__)
def test_public_names_exist(name):
    assert getattr(wpdc_gwcs, name) is not None


def names_of_the_api_page():
    """What the first table of the page says can be imported from the package itself."""
    page = Path(__file__).parents[1] / "docs" / "reference" / "api.rst"
    table = page.read_text(encoding="utf-8").split("From frames to WCS")[0]
    return re.findall(r"`~wpdc_gwcs\.([\w.]+)`", table)


def test_all_names_of_the_api_page_can_be_imported():
    names = names_of_the_api_page()
    assert len(names) > 30
    for name in names:
        module, _, last = name.rpartition(".")
        public = getattr(wpdc_gwcs, last)
        assert public is getattr(importlib.import_module(f"wpdc_gwcs.{module}"), last)
    documented = {name.rpartition(".")[2] for name in names}
    assert documented == set(wpdc_gwcs.__all__) - {"__version__"}


def test_modules_of_the_command_line_are_no_circle():
    folder = Path(wpdc_gwcs.__file__).parent / "cli"
    imports = {
        path.stem: set(re.findall(r"from wpdc_gwcs\.cli\.(\w+) import", path.read_text()))
        for path in folder.glob("*.py")
        if path.stem != "__init__"
    }
    while free := [name for name, others in imports.items() if not others]:
        imports = {n: others - set(free) for n, others in imports.items() if n not in free}
    assert imports == {}


def test_dir_lists_public_names():
    assert set(wpdc_gwcs.__all__) <= set(dir(wpdc_gwcs))


def test_unknown_name():
    with pytest.raises(AttributeError, match="no attribute 'warp'"):
        wpdc_gwcs.warp  # noqa: B018
