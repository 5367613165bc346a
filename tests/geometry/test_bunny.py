"""The bunny of the warp-lang package, in the paper's frame."""

from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.errors import GeometryError
from sdfnet.geometry.bunny import TABLE_1, beside_table_1, bunny_path, place
from sdfnet.geometry.inspection import inspection
from sdfnet.geometry.surface import Surface, load_surface


@pytest.fixture(scope="module")
def bunny() -> Surface:
    return load_surface(bunny_path())


def test_the_bunny_is_whole_and_closed(bunny: Surface) -> None:
    assert inspection(bunny).problems() == []
    assert bunny.vertices.shape == (6102, 3)
    assert bunny.as_trimesh().euler_number == 2  # one piece without a handle


def test_the_placed_bunny_agrees_with_table_1(bunny: Surface) -> None:
    vertices = place(bunny, "y", 0.1551, 0.007).vertices
    ours = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    np.testing.assert_allclose(ours[:, 0], TABLE_1[:, 0], atol=1e-12)  # set by us
    assert ours[0, 2] == pytest.approx(-0.007, abs=1e-12)  # set by us
    assert ours[0, 1] == pytest.approx(-ours[1, 1], abs=1e-12)
    np.testing.assert_allclose(ours, TABLE_1, atol=1.5e-3)  # another closed version of the same scan: 1 % of its height


def test_the_bunny_stands_upright(bunny: Surface) -> None:
    vertices = place(bunny, "y", 0.1551, 0.007).vertices
    low, high = vertices[vertices[:, 2] < 0.02], vertices[vertices[:, 2] > 0.13]
    assert len(high) > 0
    assert np.prod(np.ptp(high[:, :2], axis=0)) < 0.5 * np.prod(np.ptp(low[:, :2], axis=0))  # ears above, the wide foot below


@pytest.mark.parametrize("up_axis", ["y", "z"])
def test_placing_keeps_shape_and_handedness(bunny: Surface, up_axis: str) -> None:
    scale = 0.1551 / np.ptp(bunny.vertices[:, 0])
    placed = place(bunny, up_axis, 0.1551, 0.007)
    assert placed.as_trimesh().volume == pytest.approx(scale**3 * bunny.as_trimesh().volume, rel=1e-9)


def test_nothing_moves_when_nothing_is_asked(bunny: Surface) -> None:
    np.testing.assert_array_equal(place(bunny, "z", None, None).vertices, bunny.vertices)


def test_table_1_stands_beside_our_box() -> None:
    lines = beside_table_1(np.array([[0.0, -1.0, -2.0], [3.0, 4.0, 5.0]])).splitlines()
    assert [line.split() for line in lines[1:]] == [
        ["x", "0.0000", "0.0000", "0.1551", "3.0000"],
        ["y", "-0.0602", "-1.0000", "0.0602", "4.0000"],
        ["z", "-0.0070", "-2.0000", "0.1472", "5.0000"],
    ]


def test_a_warp_package_without_the_bunny_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere: Callable[[], str] = lambda: "nowhere"  # noqa: E731
    monkeypatch.setattr("warp.examples.get_asset_directory", nowhere)
    with pytest.raises(GeometryError, match="expected to carry the bunny at 'nowhere/bunny.usd'; reinstall warp-lang, or give"):
        bunny_path()
