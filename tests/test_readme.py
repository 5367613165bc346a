"""What the README says is run."""

import re
from pathlib import Path

import pytest

from sdfnet.plugins import find_datasets

README = (Path(__file__).parents[1] / "README.md").read_text()
SCENE, *NOTEBOOK = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)


def test_the_scene_of_the_readme_is_a_dataset(tmp_path: Path) -> None:
    (tmp_path / "shelf.py").write_text(SCENE)
    assert set(find_datasets([tmp_path])) == {"shelf"}


@pytest.mark.filterwarnings("ignore:.*logging interval.*")
def test_the_notebook_of_the_readme_runs(capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, object] = {}
    exec(compile(NOTEBOOK[0], "README.md", "exec"), names)
    assert float(re.findall(r"-?\d+\.\d+", capsys.readouterr().out)[-1]) < -0.03, "the centre of the ball lies inside"
    exec(compile(NOTEBOOK[1], "README.md", "exec"), names)
    assert float(capsys.readouterr().out.split()[-1]) < 3.0, "a few hundred steps find the ball of 50 mm"


def test_the_cantilever_of_the_readme_is_that_of_beam_theory(capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(NOTEBOOK[2], "README.md", "exec"), {})
    tip, first, *_ = (float(number) for number in re.findall(r"-?\d+\.\d+", capsys.readouterr().out))
    assert tip == pytest.approx(-0.8048, rel=0.01)  # quadratic elements, as in the reference cases
    assert first == pytest.approx(0.11349, rel=0.01)
    assert [float(number) for number in re.findall(r"# .*?(-?\d\.\d+) (?:m|Hz)", NOTEBOOK[2])] == [-0.8048, 0.1135]  # what the README says beside them


def test_every_file_that_the_readme_links_to_exists() -> None:
    links = re.findall(r"\]\((?!http)([^)]+)\)", README)
    assert links
    assert [link for link in links if not (Path(__file__).parents[1] / link).exists()] == []
