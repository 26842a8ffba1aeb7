"""The `wpdc` application: its commands, and the handling of errors, warnings and signals.

Exit status: 0 success; 1 a frame could not be solved, or a result failed its test; 2 wrong usage or
unreadable input; 130 interrupted, 143 terminated.  Every failure is one line on standard error with
the problem, the rule and the value.
"""

import gc
import logging
import os
import signal
import sys
import threading
import traceback
import warnings
from contextlib import contextmanager, suppress
from typing import Annotated

import typer
from typer.core import TyperGroup

from wpdc_gwcs.cli.hints import hint_of, similar_option
from wpdc_gwcs.exceptions import FrameFailure, InputError, WPDCError, WPDCWarning

__all__ = ["Interrupted", "app", "main", "set_verbosity"]

# As they are listed: from frames to results, then what is around it.
_ORDER = (
    "calibrate detect match show explain evaluate report export convert pix2sky sky2pix monitor "
    "catalog simulate demo reproduce"
).split()


class _Commands(TyperGroup):
    """The commands in the order of the work."""

    def list_commands(self, ctx):
        return sorted(super().list_commands(ctx), key=_ORDER.index)


app = typer.Typer(
    name="wpdc",
    cls=_Commands,
    help="Calibrate the WCS and the distortion of wide-field frames with a catalog such as Gaia.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

# Base class of errors of the command-line parser; typer exports only a subclass.
UsageError = typer.BadParameter.__bases__[0]

_INTERRUPTED = 130


class Interrupted(Exception):
    """An interrupt in a command that can be resumed, after it has written results."""


def _show_version(value: bool):
    if value:
        from wpdc_gwcs import __version__, kernels

        typer.echo(f"wpdc_gwcs {__version__} ({kernels.implementation} kernels)")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", callback=_show_version, is_eager=True
        ),
    ] = False,
):
    pass


class _OneLine(logging.Formatter):
    def format(self, record):
        text = " ".join(record.getMessage().split())
        if record.levelno >= logging.WARNING:
            return f"wpdc: {record.levelname.lower()}: {text}"
        return f"wpdc: {text}"


def set_verbosity(verbose, quiet):
    """Log to standard error: warnings, with ``-v`` progress, ``-vv`` details, ``-q`` only errors.

    Parameters
    ----------
    verbose : int
        How often ``-v`` was given.
    quiet : bool
        Whether ``-q`` was given.
    """
    level = (
        logging.ERROR if quiet else [logging.WARNING, logging.INFO, logging.DEBUG][min(verbose, 2)]
    )
    logger = logging.getLogger("wpdc_gwcs")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_OneLine())
    logger.handlers = [handler]
    logger.propagate = False
    logger.setLevel(level)

    def show(message, category, filename, lineno, file=None, line=None):
        # Our own warnings are about the user's data; those of libraries are about code: -vv.
        ours = issubclass(category, WPDCWarning)
        logger.log(logging.WARNING if ours else logging.DEBUG, "%s", message)

    warnings.simplefilter("default")
    warnings.showwarning = show


def _fail(message, status, args=None):
    text = " ".join(str(message).split())
    hint = hint_of(text, _called(args)[1])
    if hint and hint.startswith("--") and hint.split()[0].strip(",") not in _options_of(args):
        # It is for another command that reads the same kind of file.
        hint = None
    print(f"wpdc: error: {text}" + (f"; try: {hint}" if hint else ""), file=sys.stderr)
    return status


def _called(args):
    """Return the command that was called, and its words, such as "catalog info"."""
    command, words = typer.main.get_command(app), []
    for word in sys.argv[1:] if args is None else args:
        if word not in getattr(command, "commands", ()):
            break
        command = command.commands[word]
        words.append(word)
    return command, " ".join(words)


def _options_of(args):
    """Options of the command that was called, by their names."""
    return {name for parameter in _called(args)[0].params for name in parameter.opts}


def run(args=None):
    """Run the command line and return its exit status.

    Parameters
    ----------
    args : list of str, optional
        Arguments after the program's name; default ``sys.argv[1:]``.

    Returns
    -------
    int
        Exit status.
    """
    set_verbosity(0, quiet=False)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            # Names may have characters that the terminal cannot show.
            stream.reconfigure(errors="backslashreplace")
    with _signals() as received:
        return _run(args, received)


@contextmanager
def _signals():
    """Turn signals that end a program into one KeyboardInterrupt, and ignore further ones.

    Yields a list with the number of the signal.
    """
    received = []

    def interrupt(number, frame):
        for one in before:
            signal.signal(one, signal.SIG_IGN)
        received.append(number)
        raise KeyboardInterrupt

    names = ("SIGINT", "SIGTERM", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    before = {}
    if threading.current_thread() is threading.main_thread():
        # Signals that are ignored, such as SIGHUP under nohup, stay ignored.
        before = {n: signal.getsignal(n) for n in numbers if signal.getsignal(n) != signal.SIG_IGN}
    for number in before:
        signal.signal(number, interrupt)
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(args, received):
    try:
        status = app(args=args, prog_name="wpdc", standalone_mode=False)
        sys.stdout.flush()
        if status == _INTERRUPTED:  # what typer makes of Ctrl-C
            raise KeyboardInterrupt
        return status if isinstance(status, int) else 0
    except UsageError as err:
        return _usage(err)
    except InputError as err:
        return _fail(err, 2, args)
    except (FrameFailure, WPDCError) as err:
        return _fail(err, 1, args)
    except (KeyboardInterrupt, typer.Abort, Interrupted) as stop:
        status = 128 + received[0] if received else _INTERRUPTED
        done = "files already written are complete"
        if isinstance(stop, Interrupted):
            done += "; continue with --resume"
        elif "--resume" in _options_of(args):
            done = "nothing has been written"
        return _fail(f"interrupted; {done}", status)
    except BrokenPipeError:
        # The reader of our output is gone, which is not an error; the exit must not flush again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as err:
        if err.filename is None:
            return _fail(err.strerror or err, 2)
        return _fail(f"{err.filename}: {err.strerror}", 2)
    except MemoryError as err:
        return _fail(f"not enough memory: {err}", 1)
    except Exception as err:  # noqa: BLE001  A mistake of ours, told in one line like those of others.
        if logging.getLogger("wpdc_gwcs").isEnabledFor(logging.DEBUG):
            traceback.print_exception(err)
        return _fail(f"internal error: {type(err).__name__}: {err} (-vv shows where)", 1)


def _usage(err):
    message = err.format_message()
    context = getattr(err, "ctx", None)
    if type(err).__name__ == "NoArgsIsHelpError":
        print(message)
        return 2
    command = context.command_path if context is not None else "wpdc"
    if context is not None and type(err).__name__ == "NoSuchOption":
        options = [option for parameter in context.command.params for option in parameter.opts]
        meant = similar_option(err.option_name, options)
        message = err.message + (f". Did you mean {meant}?" if meant else "")
    return _fail(f"{message} (see '{command} --help')", 2)


def main():
    """Entry point of the `wpdc` command."""
    status = run()
    if status > 128:
        # Everything is written, and a user who stops a program does not want to wait for garbage
        # collection: ten seconds on a busy machine.
        with suppress(OSError, ValueError, AttributeError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)
    # The system frees the memory anyway; a final search for cycles takes an eighth of the time of a
    # small frame.
    gc.freeze()
    sys.exit(status)
