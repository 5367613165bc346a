"""The exact answers themselves: formulas that a reference case takes for true are checked against what they should solve."""

import math

import numpy as np
import pytest

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import finite_elements
from sdfnet.scene import Material
from sdfnet.verification.beams import timoshenko_frequency, timoshenko_tip
from sdfnet.verification.function_norm import relative_l2_error
from sdfnet.verification.half_space import point_force
from sdfnet.verification.meshes import box, jittered_box

STANDARD = Material(5e3, 0.0, 1.0)


def test_timoshenkos_cantilever_is_that_of_the_table() -> None:
    assert timoshenko_tip(10.0, 1.0, 1.0, STANDARD) == pytest.approx(0.8048, abs=1e-12)  # NUMERICS
    assert timoshenko_frequency(10.0, 1.0, STANDARD) == pytest.approx(0.11349, rel=1e-4)  # NUMERICS, five digits


def test_a_very_slender_cantilever_rings_as_eulers() -> None:
    length, thickness = 1000.0, 1.0
    euler = 1.8751040687**2 / (2 * math.pi) * math.sqrt(5e3 * thickness**2 / 12) / length**2
    assert timoshenko_frequency(length, thickness, STANDARD) == pytest.approx(euler, rel=1e-5)  # shear and turning are as (thickness / length)^2


def test_boussinesqs_displacement_is_in_balance_and_carries_the_force() -> None:
    """Central differences of the displacement: no force inside, no traction on the surface, the whole force through a half-sphere."""
    material, force, step = Material(2e3, 0.3, 1.0), 7.0, 1e-3

    def gradient(points: np.ndarray) -> np.ndarray:
        parts = [(point_force(points + step * axis, force, material) - point_force(points - step * axis, force, material)) / (2 * step) for axis in np.eye(3)]
        return np.stack(parts, axis=2)  # (points, component, derivative)

    def stress(points: np.ndarray) -> np.ndarray:
        g = gradient(points)
        strain = (g + g.transpose(0, 2, 1)) / 2
        return material.lame_lambda * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2 * material.lame_mu * strain

    inside = np.array([[0.3, -0.2, -0.5], [0.1, 0.4, -0.3]])
    balance = sum((stress(inside + step * axis) - stress(inside - step * axis))[:, :, k] for k, axis in enumerate(np.eye(3))) / (2 * step)
    assert np.abs(balance).max() < 1e-3 * np.abs(stress(inside)).max() / 0.3  # error of the differences, (step / distance)^2
    below_surface = np.array([[0.5, 0.2, -2 * step], [-0.3, 0.4, -2 * step]])
    assert np.abs(stress(below_surface)[:, :, 2]).max() < 0.03 * np.abs(stress(below_surface)).max()  # falls with the depth of 2 steps
    cosines, weights = np.polynomial.legendre.leggauss(20)
    polar, azimuth = np.meshgrid((cosines - 1) / 2, np.arange(8) * math.pi / 4)  # z of the unit half-sphere, angle about z
    outward = np.stack([np.sqrt(1 - polar**2) * np.cos(azimuth), np.sqrt(1 - polar**2) * np.sin(azimuth), polar], axis=-1).reshape(-1, 3)
    pulls = np.einsum("pij,pj->pi", stress(outward), outward).reshape(8, 20, 3)
    through = np.einsum("apc,p->c", pulls, weights / 2) * 2 * math.pi / 8
    np.testing.assert_allclose(through, [0, 0, force], atol=1e-4 * force)  # the outer part holds against the push down


def test_the_norm_integrates_quadratic_fields_exactly() -> None:
    mesh = jittered_box()
    elements = finite_elements(mesh, "P2")
    x, y, z = elements.nodes.T
    quadratic = np.stack([x * y, z**2 - x, 1 + y * z], axis=1)

    def shifted(points: np.ndarray) -> np.ndarray:
        a, b, c = points.T
        return np.stack([a * b, c**2 - a, 1 + b * c + 0.1 * a], axis=1)

    integral = {"x2": 2**3 / 3 * 1 * 1.5}  # of x^2 over 2 x 1 x 1.5
    squared = integral["x2"] * 0.01
    exact_norm = _squared_norm_of_shifted()
    assert relative_l2_error(elements, quadratic, shifted) == pytest.approx(math.sqrt(squared / exact_norm), rel=1e-12)


def _squared_norm_of_shifted() -> float:
    """By Gauss points of the whole box, exact for degree 9 along each side."""
    points, weights = np.polynomial.legendre.leggauss(5)
    sides = [(side / 2 * (points + 1), side / 2 * weights) for side in (2.0, 1.0, 1.5)]
    x, y, z = np.meshgrid(*(coordinates for coordinates, _ in sides), indexing="ij")
    weight = np.einsum("i,j,k->ijk", *(weight for _, weight in sides))
    return float((weight * ((x * y) ** 2 + (z**2 - x) ** 2 + (1 + y * z + 0.1 * x) ** 2)).sum())


def test_boxes_fill_their_volume_and_jitter_moves_inner_nodes_alone() -> None:
    regular, moved = box(np.array([0.0, 1.0, 3.0]), np.array([0.0, 2.0]), np.array([0.0, 1.0, 2.0, 4.0])), jittered_box(0.5)
    assert regular.volumes.sum() == pytest.approx(3 * 2 * 4, rel=1e-14)
    assert isinstance(moved, TetMesh)
    assert moved.volumes.sum() == pytest.approx(0.125 * 3, rel=1e-14)
    assert np.ptp(moved.nodes, axis=0).tolist() == [1.0, 0.5, 0.75]
    grid = np.stack([moved.nodes[:, k] / np.array([0.25, 0.5 / 3, 0.1875])[k] for k in range(3)], axis=1)
    off = np.abs(grid - np.rint(grid)).max(axis=1) > 1e-9
    assert off.any()
    assert not off[moved.surface_nodes].any()
