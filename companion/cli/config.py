"""`mavfdi config AIRFRAME`: the configuration that results, each value with where it came from."""

import argparse
import json

from companion import airframe as airframes
from companion.cli import arguments
from companion.configuration import leaves


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("airframe")
    arguments.add_config(parser)


def main(args: argparse.Namespace) -> int:
    source = airframes.load(args.airframe, args.config).source
    for path, value in leaves(source.table):
        print(f"{path} = {json.dumps(value)}  # {source.origins[path]}")
    return 0
