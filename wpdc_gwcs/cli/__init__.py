"""The command line: `wpdc`."""

# The commands register themselves with the application.
from wpdc_gwcs.cli import calibrate, catalog, demo, export, files, report, show, stages  # noqa: F401
from wpdc_gwcs.cli.app import app, main

__all__ = ["app", "main"]
