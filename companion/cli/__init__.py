"""The command `mavfdi`: thin modules, one a command, each with `add_arguments` and `main`.

A user's mistake is one line on standard error and exit code 2; a bug shows its traceback.
"""

import argparse
import importlib
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Final

from companion.errors import UserError

COMMANDS: Final = {  # name -> what `mavfdi --help` says of it
    "run": "watch a vehicle: monitor, alarm, record, recover",
    "sitl": "fly a simulated vehicle that speaks MAVLink",
    "demo": "fly, break, watch and mend in one go",
    "analyze": "say what happened in telemetry logs",
    "info": "print what is in telemetry logs, without judging",
    "export": "write a log's messages as Parquet or CSV",
    "montecarlo": "fly thousands of simulated flights, one row a flight",
    "config": "print an airframe's configuration and where each value comes from",
}
FAILED: Final = 2


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="mavfdi", description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--version", action="version", version=f"mavfdi {version('mavfdi')}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of a user's mistake too")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    words = list(sys.argv[1:] if arguments is None else arguments)
    wanted = next((word for word in words if word in COMMANDS), None)
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text)
        if name == wanted:  # only what is called is imported: a start on a small board takes its time
            importlib.import_module(f"companion.cli.{name}").add_arguments(command)
    args = parser.parse_args(words)
    try:
        code: int = importlib.import_module(f"companion.cli.{args.command}").main(args)
    except UserError as error:
        if args.debug:
            raise
        print(f"mavfdi {args.command}: {error}", file=sys.stderr)
        return FAILED
    except BrokenPipeError:
        return FAILED
    return code


if __name__ == "__main__":
    sys.exit(main())
