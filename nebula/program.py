"""The ``nebula`` program: a command's result, or one line of error and an exit status."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

import click

from gaussians.errors import InputError
from nebula.cli import cli

SUCCESS, INTERNAL_ERROR, USER_ERROR, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """The ``nebula`` program: run, report any error in one line, exit with its status."""
    signal.signal(signal.SIGTERM, _terminate)
    status = SUCCESS
    try:
        with cli.make_context(
            "nebula", list(sys.argv[1:] if arguments is None else arguments)
        ) as ctx:
            cli.invoke(ctx)
        sys.stdout.flush()
    except click.exceptions.Exit as end:  # --help, --version
        status = end.exit_code
    except BrokenPipeError:  # whoever reads our output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    except (KeyboardInterrupt, click.Abort):
        _complain("interrupted")
        status = INTERRUPTED
    except Exception as error:
        if os.environ.get("NEBULA_TRACEBACK") == "1":
            raise
        message, status = _explain(error)
        _complain(message)
    sys.exit(status)


def _explain(error: Exception) -> tuple[str, int]:
    """One line about an error, and the exit status it leads to."""
    if isinstance(error, click.UsageError):
        command = error.ctx.command_path if error.ctx else "nebula"
        return f"{error.format_message()} (see {command} --help)", USER_ERROR
    if isinstance(error, click.ClickException):
        return error.format_message(), USER_ERROR
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}", USER_ERROR
    if isinstance(error, MemoryError):
        return f"not enough memory: {error}", USER_ERROR
    if isinstance(error, (InputError, OSError)):
        return str(error), USER_ERROR
    kind = type(error).__name__
    hint = "a fault of the program; NEBULA_TRACEBACK=1 shows where"
    return f"{kind}: {error} ({hint})", INTERNAL_ERROR


def _complain(message: str) -> None:
    print(f"nebula: error: {' '.join(message.split())}", file=sys.stderr)


def _terminate(number: int, frame: object) -> NoReturn:
    """SIGTERM ends the program by an exception, so that half-written files are removed."""
    sys.exit(TERMINATED)
