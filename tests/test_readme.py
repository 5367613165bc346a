"""What the README says is run."""

import re
from pathlib import Path

import pytest

from sdfnet.plugins import find_datasets

README = (Path(__file__).parents[1] / "README.md").read_text()
SCENE, NOTEBOOK = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_the_scene_of_the_readme_is_a_dataset(tmp_path: Path) -> None:
    (tmp_path / "shelf.py").write_text(SCENE)
    assert set(find_datasets([tmp_path])) == {"shelf"}


def test_the_notebook_of_the_readme_runs(capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(NOTEBOOK, "README.md", "exec"), {})
    assert float(re.findall(r"-?\d+\.\d+", capsys.readouterr().out)[-1]) < -0.03, "the centre of the ball lies inside"


def test_every_file_that_the_readme_links_to_exists() -> None:
    links = re.findall(r"\]\((?!http)([^)]+)\)", README)
    assert links
    assert [link for link in links if not (Path(__file__).parents[1] / link).exists()] == []
