import subprocess
import sys

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


def test_dir_lists_public_names():
    assert set(wpdc_gwcs.__all__) <= set(dir(wpdc_gwcs))


def test_unknown_name():
    with pytest.raises(AttributeError, match="no attribute 'warp'"):
        wpdc_gwcs.warp  # noqa: B018
