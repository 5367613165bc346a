"""What commands print is whole, whatever is in it."""

import pytest
from rich.table import Table

from sdfnet.cli.screen import screen


def test_brackets_and_long_lines_come_out_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    said = "written to outputs/[red]/strategy=[latent_32] " + "and on " * 60
    table = Table("setting", "error")
    table.add_row("[fourier] " + "x" * 200, "0.1")
    console = screen()
    console.print(said)
    console.print(table)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].rstrip() == said.rstrip()
    assert any("[fourier] " + "x" * 200 in line and "0.1" in line for line in lines)
