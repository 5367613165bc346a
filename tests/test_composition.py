"""What a dataset returns is its configuration: through Hydra and back, with overrides in it."""

from dataclasses import dataclass, field
from typing import Any

import pytest
from hydra.errors import ConfigCompositionException
from omegaconf.errors import OmegaConfBaseException

from sdfnet.cli.entry import register
from sdfnet.errors import ConfigurationError
from sdfnet.plugins import find_datasets, frozen, shipped, writable
from tests.composition import composed, composed_dataset

pytestmark = pytest.mark.usefixtures("clean_store")


def test_a_dataset_survives_the_way_through_hydra_unchanged() -> None:
    for name, made in find_datasets([shipped("datasets")]).items():
        assert composed_dataset(f"dataset={name}") == made


def test_tuples_come_back_as_tuples_with_overrides_in_them() -> None:
    made = composed_dataset("dataset=beam_bend", "dataset.scene.geometry.cells=[4,2,2]", "dataset.scene.effects.weight.density=[0,1,2.5]")
    assert made.scene.geometry.cells == (4, 2, 2)  # type: ignore[attr-defined]
    assert made.scene.effects["weight"].density == (0.0, 1.0, 2.5)  # type: ignore[attr-defined]
    assert made.scene.effects["wall"].components == (True, True, True)  # type: ignore[attr-defined]


def test_every_level_can_be_overridden_and_the_rest_stays() -> None:
    made = composed_dataset(
        "dataset=sphere_squeeze", "dataset.scene.effects.left.pressure=7", "dataset.scene.solver.time_step=1e-6", "dataset.sampling.count=11"
    )
    assert made.scene.effects["left"].pressure == 7.0  # type: ignore[attr-defined]
    assert made.scene.effects["right"].pressure == 1000.0  # type: ignore[attr-defined]
    assert made.scene.solver.time_step == 1e-6
    assert composed_dataset("dataset.scene.solver.time_step=1").scene.solver.time_step == 1.0
    assert (made.sampling.count, made.sampling.near_surface_count) == (11, 10_000)


def test_an_effect_is_removed_with_a_tilde() -> None:
    assert set(composed_dataset("dataset=sphere_squeeze", "~dataset.scene.effects.right").scene.effects) == {"left"}


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("dataset.scene.recording.frames=null", "field 'dataset.scene.recording.frames' is not Optional"),
        ("dataset.scene.geometry.radios=1", "radios"),
    ],
)
def test_a_wrong_type_or_key_is_refused_at_composition(override: str, reason: str) -> None:
    register("prepare")
    with pytest.raises((ConfigCompositionException, OmegaConfBaseException)) as caught:
        composed("prepare", "dataset=sphere_squeeze", override)
    assert reason in f"{caught.value} {caught.value.__cause__}"


@dataclass(frozen=True)
class Inner:
    """Settings inside settings."""

    pair: tuple[int, int] = (1, 2)


@dataclass(frozen=True)
class Outer:
    """Settings with all that a plugin may hold."""

    needed: int  # m, and needed
    inner: Inner = field(default_factory=Inner)
    named: dict[str, Inner] = field(default_factory=lambda: {"a": Inner()})
    nothing: float | None = None


def test_nested_settings_are_writable_and_come_back_frozen_and_equal() -> None:
    settings = Outer(needed=1)
    node: Any = writable(settings)
    node.named.a.pair[1] = 9
    node.nothing = 0.5
    assert frozen(node) == Outer(1, named={"a": Inner((1, 9))}, nothing=0.5)
    assert settings == Outer(needed=1)


def test_a_setting_without_a_value_is_named() -> None:
    with pytest.raises(
        ConfigurationError,
        match=r"these settings have no value yet: needed: a whole number \(m, and needed\); give each on the command line, such as 'needed=1'",
    ):
        frozen(writable(Outer))
