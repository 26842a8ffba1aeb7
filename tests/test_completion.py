"""What the shell offers for an option is what the option takes."""

import pytest
import typer

from wpdc_gwcs import RadialWeight
from wpdc_gwcs.cli import app
from wpdc_gwcs.cli.options import preset_names

GROUP = typer.main.get_command(app)


def offered(command, option, incomplete=""):
    context = command.make_context("wpdc", [], resilient_parsing=True)
    (parameter,) = [p for p in command.params if option in p.opts]
    return [item.value for item in parameter.shell_complete(context, incomplete)]


@pytest.mark.parametrize("name", sorted(set(GROUP.commands) - {"catalog"}))
def test_values_in_braces_are_offered(name):
    command = GROUP.commands[name]
    for parameter in command.params:
        if (parameter.metavar or "").startswith("{") and parameter.opts[0].startswith("-"):
            values = parameter.metavar.strip("{}").replace("1...7", "1,2,3,4,5,6,7").split(",")
            assert offered(command, parameter.opts[0]) == values


def test_names_are_offered():
    calibrate = GROUP.commands["calibrate"]
    assert offered(calibrate, "--preset") == preset_names()
    assert set(offered(calibrate, "--weight")) > set(RadialWeight.names)
    assert {RadialWeight(w).name for w in offered(calibrate, "--weight")} == set(RadialWeight.names)
    assert offered(calibrate, "--weight", "inv") == ["inverse", "inverse-square"]
    assert set(offered(GROUP.commands["simulate"], "--preset")) == set(preset_names())
