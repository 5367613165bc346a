"""python verify.py: the table of reference cases."""

import csv
import math
import time
from dataclasses import asdict
from pathlib import Path

import torch
from rich.progress import Progress
from rich.table import Table

from sdfnet.cli.muted import muted
from sdfnet.cli.screen import screen
from sdfnet.cli.settings import ALL_CASES, VerifySettings
from sdfnet.data.store import finite, write_json, written_whole
from sdfnet.data.versions import versions
from sdfnet.errors import PhysicsError, SdfnetError
from sdfnet.verification import CASES, Row, rows_of


def verify(settings: VerifySettings, output: Path) -> None:
    """Run the reference cases, print and write exact, found, error and verdict. Raises PhysicsError when a row fails."""
    torch.set_num_threads(1)  # the solids are so small that a second thread only waits: three times as long on two busy cores
    names = list(CASES) if settings.case == ALL_CASES else [settings.case]
    rows: list[Row] = []
    seconds: dict[str, float] = {}
    with Progress(transient=True) as bars, muted("sdfnet.physics"):  # scenes are locked, free or at rest on purpose
        task = bars.add_task("reference cases", total=len(names))
        for name in names:
            began = time.perf_counter()
            rows += _rows_or_reason(name)
            seconds[name] = time.perf_counter() - began
            bars.advance(task)
    console = screen()
    console.print(table_of(rows))
    _write(output, rows, seconds)
    failed = [row for row in rows if not row.passes]
    console.print(f"{len(rows) - len(failed)} of {len(rows)} rows of {len(names)} cases hold, {sum(seconds.values()):.0f} s; written to {output}")
    if failed:
        which = "; ".join(f"{row.case} ({row.setup}): {row.quantity}, {_found(row)}" for row in failed)
        raise PhysicsError(
            f"every reference case must hold, found {len(failed)} of {len(rows)} rows that do not: {which}. "
            f"Results of this code are not to be trusted until they do; run python verify.py case={failed[0].case} while mending it"
        )


def _rows_or_reason(name: str) -> list[Row]:
    """The rows of a case; one that fails and says why when the case cannot be run, so that the others still are."""
    try:
        return rows_of(name)
    except SdfnetError as error:
        return [Row(str(error), "cannot be run", math.nan, math.nan, math.nan, 0.0, case=name)]


def table_of(rows: list[Row]) -> Table:
    """Every row, under the name of its case."""
    table = Table(title="reference cases", title_justify="left")
    for name in ("case", "setup", "quantity"):
        table.add_column(name)
    for name in ("exact", "found", "error", "tolerance", "verdict"):
        table.add_column(name, justify="right", no_wrap=True)
    for before, row in zip([None, *rows], rows, strict=False):
        is_first = before is None or before.case != row.case
        if is_first and before is not None:
            table.add_section()
        cells = [
            "" if math.isnan(row.exact) else _number(row.exact, row.unit),
            _number(row.found, row.unit),
            "" if math.isnan(row.error) else f"{row.error:.1e}",
        ]
        table.add_row(row.case if is_first else "", row.setup, row.quantity, *cells, row.criterion, "holds" if row.passes else "FAILS")
    return table


def _found(row: Row) -> str:
    """A row in words, for the message of a failure."""
    exact = "" if math.isnan(row.exact) else f" for {_number(row.exact, row.unit)}, error {row.error:.2g}"
    return f"{_number(row.found, row.unit)}{exact}, must be {row.criterion}"


def _number(value: float, unit: str) -> str:
    return f"{value:.5g} {unit}".strip()


def _write(output: Path, rows: list[Row], seconds: dict[str, float]) -> None:
    """verification.json and verification.csv: a record for each row; what is not finite is null in the one and empty in the other."""
    records = [finite(asdict(row)) | {"passes": row.passes} for row in rows]
    write_json(output / "verification.json", {"rows": records, "seconds": seconds, "versions": versions()})
    with written_whole(output / "verification.csv") as unfinished, unfinished.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(records[0]))
        writer.writeheader()
        writer.writerows(records)
