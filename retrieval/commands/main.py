"""The command line `retrieve`: its commands, and the rules for all of them.

Results go to stdout, everything else to stderr. Exit codes: 0 done, 1 the job ran and failed, 2 wrong use or bad input.
The function of a command can also be called from Python; its docstring is the help text.
"""

import atexit
import errno
import gc
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any

import typer

from retrieval.commands.options import Command
from retrieval.console.interruption import record_interrupts
from retrieval.console.memory import keep_freed_memory
from retrieval.console.output import checked_stdout, discard_stdout, prepare_streams, say, show
from retrieval.console.progress import Bar, show_progress
from retrieval.version import __version__

_BAD_PATH_ERRNOS = {
    *(errno.ENOENT, errno.EISDIR, errno.ENOTDIR, errno.EACCES, errno.EPERM, errno.EROFS),
    *(errno.EINVAL, errno.ENAMETOOLONG, errno.ELOOP, errno.EEXIST),
}

GROUPS = ("rig",)
COMMANDS = (
    *("demo", "collect", "import", "export-recording", "check", "train", "build-index", "enrol", "query"),
    *("verify", "identify", "export", "push", "evaluate", "frontier", "serve", *GROUPS),
)
KEEP_FREED_MEMORY = {"train", "build-index", "evaluate"}
"""Commands that compute with large tensors until they end."""


def application(names: Sequence[str] = COMMANDS) -> typer.Typer:
    """Return the command line with the named commands and groups, which it imports."""
    app = typer.Typer(
        # Without markup, rich is not imported.
        rich_markup_mode=None,
        add_completion=False,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    )
    app.callback()(retrieve)
    for name in names:
        function = "import_" if name == "import" else name.replace("-", "_")
        module = import_module(f"retrieval.commands.{function}")
        if name in GROUPS:
            app.add_typer(module.app)
        else:
            app.command(name, cls=Command)(getattr(module, function))
    return app


def _print_version(is_given: bool) -> None:
    if is_given:
        show(f"touch-retrieval {__version__}")
        raise typer.Exit


def retrieve(
    *,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="show the version and exit"),
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="show the traceback of an error")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="show the steps and figures of all work")] = False,
) -> None:
    """From the gel images of a grasp, find the catalogue photo of the object in the hand."""
    Bar.is_verbose = verbose


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code.

    Args:
        argv: Words after the program name; None for those of `sys.argv`.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    first = next((word for word in words if not word.startswith("-")), None)
    # A help text or a wrong word needs all commands; to import them takes a tenth of the time of a query.
    names = [first] if first in COMMANDS else COMMANDS
    if argv is None:  # the process ends with the command: its end need not search all objects for reference cycles
        atexit.register(gc.freeze)
        if KEEP_FREED_MEMORY.issuperset(names):
            keep_freed_memory()
    # A stream that the shell closed (`2>&-`) is None, and printing to None prints to stdout.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    prepare_streams()
    program = typer.main.get_command(application(names))
    context: Any = None
    before = Bar.is_on, Bar.is_verbose
    show_progress()
    with record_interrupts() as interrupts:
        # Not program.main(): it handles Ctrl-C and closed pipes in its own way.
        try:
            context = program.make_context("retrieve", words)
            with context:
                code = program.invoke(context)
            with checked_stdout():
                sys.stdout.flush()
            return code or 0
        except typer.Exit as done:  # after --help or --version
            return done.exit_code
        except typer.TyperException as wrong:
            return _fail(context, f"{wrong.format_message().rstrip('.')}; see --help", wrong.exit_code)
        except BrokenPipeError:  # the reader of stdout closed it, like `| head`
            discard_stdout()
            return 1
        except (Exception, KeyboardInterrupt) as error:
            if isinstance(error, Exception) and context is not None and context.params["debug"]:
                raise
            return _explain(context, error, interrupts)
        finally:
            Bar.is_on, Bar.is_verbose = before


def _explain(context: Any, error: BaseException, interrupts: list[int]) -> int:
    """Print an error in one line; return the exit code."""
    code = getattr(error, "exit_code", None)  # all errors of the project have one
    if code is not None:
        return _fail(context, str(error), code)
    if interrupts or isinstance(error, KeyboardInterrupt):
        return _fail(context, f"stopped by {'SIGTERM' if signal.SIGTERM in interrupts else 'Ctrl-C'}", 1)
    if isinstance(error, OSError):  # wrong use if another path would have worked
        message = f"{error.filename or 'a file'}: {error.strerror or error}"
        return _fail(context, message, 2 if error.errno in _BAD_PATH_ERRNOS else 1)
    return _fail(context, f"unexpected {type(error).__name__}: {error} (run with --debug and report it)", 1)


def _fail(context: Any, message: str, code: int) -> int:
    words = ["retrieve"] if context is None else ["retrieve", context.invoked_subcommand]
    say(f"{' '.join(filter(None, words))}: {message}")
    return code
