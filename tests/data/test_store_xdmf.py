"""A trajectory opens elsewhere: the .xdmf beside it is read here by hand and by VTK."""

from typing import Any
from xml.etree import ElementTree

import h5py
import meshio
import numpy as np
import pytest
import pyvista

from sdfnet.data import store
from tests.data.stored_examples import PROVENANCE, TRAJECTORY, small_trajectory


def test_the_xdmf_shows_every_frame_to_a_reader_that_knows_nothing_of_sdfnet() -> None:
    trajectory = small_trajectory()
    store.write_trajectory(TRAJECTORY, trajectory, PROVENANCE)
    root = ElementTree.parse("trajectory.xdmf").getroot()
    grids = root.findall("./Domain/Grid/Grid")
    assert len(grids) == 4

    def values(item: ElementTree.Element) -> np.ndarray:
        if item.get("ItemType") == "HyperSlab":
            selection, source = item.findall("DataItem")
            start, stride, count = np.array(str(selection.text).split(), dtype=int).reshape([int(n) for n in str(selection.get("Dimensions")).split()])
            whole = values(source)
            part = whole[tuple(slice(s, s + k * c, k) for s, k, c in zip(start, stride, count, strict=True))]
            return part.reshape([int(n) for n in str(item.get("Dimensions")).split()])
        name, place = str(item.text).strip().split(":")
        with h5py.File(name) as file:
            stored = file[place]
            assert [int(n) for n in str(item.get("Dimensions")).split()] == list(stored.shape)
            assert stored.dtype.itemsize == int(str(item.get("Precision")))
            assert stored.dtype.kind == {"Float": "f", "Int": "i"}[str(item.get("NumberType"))]
            return np.asarray(stored)

    for frame, grid in enumerate(grids):
        time, topology, geometry, attribute = (grid.find(name) for name in ("Time", "Topology", "Geometry", "Attribute"))
        assert time is not None
        assert float(str(time.get("Value"))) == pytest.approx(trajectory.times[frame], rel=1e-8)
        for element, expected in ((topology, trajectory.mesh.tets), (geometry, trajectory.mesh.nodes), (attribute, trajectory.displacements[frame])):
            assert element is not None
            np.testing.assert_array_equal(values(element[0]), expected)


def test_paraviews_own_reader_finds_the_displaced_tets() -> None:
    trajectory = small_trajectory()
    store.write_trajectory(TRAJECTORY, trajectory, PROVENANCE)
    reader = pyvista.get_reader("trajectory.xdmf")
    assert isinstance(reader, pyvista.XdmfReader)
    np.testing.assert_allclose(reader.time_values, trajectory.times, rtol=1e-8)
    reader.set_active_time_value(reader.time_values[2])
    grid: Any = reader.read()
    while isinstance(grid, pyvista.MultiBlock):
        grid = grid[0]
    assert grid.n_cells == len(trajectory.mesh.tets)
    np.testing.assert_array_equal(grid.point_data["displacement"], trajectory.displacements[2])


def test_meshio_reads_the_series() -> None:
    trajectory = small_trajectory()
    store.write_trajectory(TRAJECTORY, trajectory, PROVENANCE)
    with meshio.xdmf.TimeSeriesReader("trajectory.xdmf") as reader:
        points, cells = reader.read_points_cells()
        np.testing.assert_array_equal(points, trajectory.mesh.nodes)
        np.testing.assert_array_equal(cells[0].data, trajectory.mesh.tets)
        assert reader.num_steps == len(trajectory.times)
        for frame, moment in enumerate(trajectory.times):
            time, point_data, _ = reader.read_data(frame)
            assert time == pytest.approx(moment, rel=1e-8)
            np.testing.assert_array_equal(point_data["displacement"], trajectory.displacements[frame])
