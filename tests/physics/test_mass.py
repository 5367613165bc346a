"""Multiplying by the mass of the free components, and solving with it."""

from collections.abc import Callable

import numpy as np
import pytest

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.mass import mass_of
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]


@pytest.fixture(scope="module", params=["P1", "P2"])
def model(make_box: MakeBox, request: pytest.FixtureRequest) -> ElasticModel:
    return assemble(make_box([0, 0.5, 1], [0, 1], [0, 1, 2], jitter=0.2), Material(density=7.0), request.param)


def constraints(model: ElasticModel) -> dict[str, np.ndarray]:
    """No component held, a foot, different nodes for each component, and one component held everywhere."""
    nodes = model.elements.nodes
    free, foot, mixed, plane = (np.zeros((len(nodes), 3), dtype=np.bool_) for _ in range(4))
    foot[nodes[:, 2] == 0] = True
    mixed[nodes[:, 0] == 0, 0] = True
    mixed[nodes[:, 1] == 0, 1] = True
    plane[:, 1] = True
    plane[nodes[:, 2] == 0] = True
    return {"free": free, "foot": foot, "mixed": mixed, "plane": plane}


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
@pytest.mark.parametrize("name", ["free", "foot", "mixed", "plane"])
def test_product_and_solve_are_those_of_the_dense_restricted_matrix(model: ElasticModel, kind: str, name: str) -> None:
    fixed = constraints(model)[name]
    free = np.flatnonzero(~fixed.ravel())
    scalar = np.diag(model.lumped_mass) if kind == "lumped" else model.consistent_mass.toarray()
    dense = np.kron(scalar, np.eye(3))[np.ix_(free, free)]
    values = np.random.default_rng(0).standard_normal((len(free), 4))
    mass = mass_of(kind, model, fixed)
    np.testing.assert_allclose(mass.product(values), dense @ values, atol=1e-13 * dense.max())
    np.testing.assert_allclose(dense @ mass.solve(values), values, atol=1e-12)
    np.testing.assert_allclose(mass.matrix().toarray(), dense, atol=1e-15 * dense.max())
