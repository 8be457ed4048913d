"""`mavfdi export LOG --types A,B --out DIR`: messages as tables that other programs open."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from companion.cli import compiling
from companion.errors import UserError

if TYPE_CHECKING:
    from companion.columns import Columns


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", metavar="LOG", type=Path, help=".tlog or .tlog.gz")
    parser.add_argument("--types", metavar="A,B", help="messages to write, for example ATTITUDE,GPS_RAW_INT; default: all")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True)
    parser.add_argument("--format", choices=["parquet", "csv"], default="parquet")
    parser.add_argument("--systems", metavar="1,2", help="of these systems only")


def main(args: argparse.Namespace) -> int:
    try:
        from companion import columns
    except ModuleNotFoundError:
        raise UserError("export needs numba; install it with: pip install 'mavfdi[analysis]'") from None
    types = args.types.split(",") if args.types else None
    try:
        systems = [int(text) for text in args.systems.split(",")] if args.systems else None
    except ValueError:
        raise UserError(f"--systems {args.systems}: give numbers, for example 1,2") from None
    compiling.announce([args.log], always=True)
    found = columns.read(args.log).columns(types, systems=systems)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        for name, table in found.items():
            path = args.out / f"{name}.{args.format}"
            (write_parquet if args.format == "parquet" else write_csv)(path, flat(table))
            print(f"{path}: {len(table.frames)} rows", flush=True)
    except OSError as error:
        raise UserError(f"{args.out}: cannot write here: {error.strerror or error}") from None
    for name in sorted(set(types or ()) - set(found)):
        print(f"{name}: none in this log", flush=True)
    return 0


def flat(table: "Columns") -> dict[str, np.ndarray]:
    """One-dimensional columns by name: stamp, source, then the fields with their SI unit; arrays as name_0, name_1, ..."""
    out: dict[str, np.ndarray] = {"stamp_us": table.stamp_us, "sysid": table.sysid, "compid": table.compid}
    for name, column in table.fields.items():
        unit = table.units[name]
        label = name if unit == "1" or name.endswith(f"_{unit}") else f"{name}_{unit}"
        if column.ndim > 1:
            out |= {f"{label}_{place}": column[:, place] for place in range(column.shape[1])}
        else:
            out[label] = column
    return out


def write_parquet(path: Path, table: dict[str, np.ndarray]) -> None:
    try:
        import pyarrow
        from pyarrow import parquet
    except ModuleNotFoundError:
        raise UserError("Parquet needs pyarrow; install it with: pip install 'mavfdi[analysis]', or --format csv") from None
    arrays = {name: _texts(column) if column.dtype.kind == "S" else column for name, column in table.items()}
    parquet.write_table(pyarrow.table(arrays), path)


def write_csv(path: Path, table: dict[str, np.ndarray]) -> None:
    """Comma separated, numbers in their shortest form that reads back the same, texts in quotes."""
    import csv

    columns = [_texts(column) if column.dtype.kind == "S" else column.tolist() for column in table.values()]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows(zip(*columns, strict=True))


def _texts(column: np.ndarray) -> list[str]:
    return [text.decode("utf-8", "replace") for text in column.tolist()]
