"""The command line: `wpdc`."""

# The commands register themselves with the application.
from wpdc_gwcs.cli import (  # noqa: F401
    calibrate,
    catalog,
    demo,
    evaluate,
    export,
    files,
    monitor,
    report,
    reproduce,
    show,
    simulate,
    stages,
)
from wpdc_gwcs.cli.app import app, main

__all__ = ["app", "main"]
