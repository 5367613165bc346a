"""The loaded patch: its area, its force, and what is refused."""

import logging
import math
from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]
RADIUS, PRESSURE = 0.003, 4000.0
DISC_FORCE = PRESSURE * math.pi * RADIUS**2


@pytest.fixture(scope="module")
def block(make_box: MakeBox) -> ElasticModel:
    """A block with edges of 5 mm: longer than the patch's radius, as on the bunny."""
    axis = np.linspace(0, 0.04, 9)
    return assemble(make_box(axis, axis, axis), Material())


def test_the_paper_patch_carries_pressure_times_disc_area_though_faces_are_larger(block: ElasticModel) -> None:
    load = PressurePoke(center=(0.0213, 0.0187, 0.04)).load(block)
    np.testing.assert_allclose(load.nodal_force.sum(axis=0), [0, 0, -DISC_FORCE], rtol=0.008, atol=1e-12)  # the worst of 300 places was 0.7 %
    assert load.report["loaded_area_m2"] == pytest.approx(math.pi * RADIUS**2, rel=0.008)
    assert load.report["resultant_N"] == pytest.approx(PRESSURE * float(load.report["loaded_area_m2"]), rel=1e-12)
    assert load.report["disc_resultant_N"] == pytest.approx(DISC_FORCE, rel=1e-12)
    assert load.stress == PRESSURE


def test_the_force_acts_at_the_centre_of_the_patch(block: ElasticModel) -> None:
    force = PressurePoke(center=(0.0213, 0.0187, 0.04)).load(block).nodal_force
    place = (block.mesh.nodes * force[:, 2:]).sum(axis=0) / force[:, 2].sum()
    np.testing.assert_allclose(place, [0.0213, 0.0187, 0.04], atol=0.02 * RADIUS)


def test_only_corners_of_faces_under_the_patch_are_loaded(block: ElasticModel) -> None:
    center = np.array([0.0213, 0.0187, 0.04])
    force = PressurePoke(center=(0.0213, 0.0187, 0.04)).load(block).nodal_force
    loaded = np.flatnonzero(np.abs(force).max(axis=1) > 0)
    assert np.linalg.norm(block.mesh.nodes[loaded] - center, axis=1).max() <= RADIUS + 0.005 * math.sqrt(2)


def test_a_given_direction_is_followed_whatever_its_length(block: ElasticModel) -> None:
    force = PressurePoke(center=(0.02, 0.02, 0.04), direction=(0.0, 5.0, 0.0)).load(block).nodal_force.sum(axis=0)
    np.testing.assert_allclose(force, [0, DISC_FORCE, 0], rtol=0.008, atol=1e-12)


def test_a_negative_pressure_pulls(block: ElasticModel) -> None:
    force = PressurePoke(center=(0.02, 0.02, 0.04), pressure=-PRESSURE).load(block).nodal_force.sum(axis=0)
    np.testing.assert_allclose(force, [0, 0, DISC_FORCE], rtol=0.008, atol=1e-12)


def test_no_pressure_loads_nothing_and_still_reports_its_area(block: ElasticModel) -> None:
    load = PressurePoke(center=(0.0213, 0.0187, 0.04), pressure=0.0).load(block)
    assert not load.nodal_force.any()
    assert load.report["loaded_area_m2"] == pytest.approx(math.pi * RADIUS**2, rel=0.008)


@pytest.mark.parametrize("element", ["P1_nodal_pressure", "P2"])
def test_every_element_carries_the_same_force_at_the_same_place(block: ElasticModel, element: str) -> None:
    poke = PressurePoke(center=(0.0213, 0.0187, 0.04))
    expected, model = poke.load(block), assemble(block.mesh, Material(), element)
    found = poke.load(model)
    np.testing.assert_allclose(found.nodal_force.sum(axis=0), expected.nodal_force.sum(axis=0), rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(model.elements.nodes.T @ found.nodal_force, block.mesh.nodes.T @ expected.nodal_force, rtol=1e-12, atol=1e-15)


def test_a_patch_across_an_edge_is_reported_with_a_warning(block: ElasticModel, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        PressurePoke(center=(0.02, 0.02, 0.04)).load(block)
        PressurePoke(center=(0.0, 0.0, 0.04)).load(block)
    assert [record.levelname for record in caplog.records] == ["INFO", "WARNING"]
    assert "of pi R^2 = 2.827e-05 m^2" in caplog.text


def test_a_patch_that_loads_nothing_names_the_nearest_surface(block: ElasticModel) -> None:
    message = r"found nothing within 0.003 m of \(0.02, 0.01, 0.05\) m: the nearest surface is 0.01 m away at \(0.02, 0.01, 0.04\) m; move poke.center there"
    with pytest.raises(PhysicsError, match=message):
        PressurePoke(center=(0.02, 0.01, 0.05)).load(block)


def test_a_patch_between_the_quadrature_points_is_not_blamed_on_its_place(block: ElasticModel) -> None:
    with pytest.raises(PhysicsError, match="enlarge poke.radius or refine the mesh"):
        PressurePoke(center=(0.02, 0.02, 0.04), radius=1e-7).load(block)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"radius": 0.0}, "poke.radius must be positive and finite, found 0.0 m"),
        ({"pressure": math.nan}, "poke.pressure must be finite"),
        ({"direction": (0.0, 0.0, 0.0)}, "poke.direction must be finite and not zero"),
    ],
)
def test_meaningless_settings_are_refused(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        PressurePoke(center=(0.0, 0.0, 0.0), **settings)  # type: ignore[arg-type]
