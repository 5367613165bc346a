"""Files come back to the bit and say what they are; a name follows what a file was made from."""

import importlib
import json
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from sdfnet.data import store
from sdfnet.data.versions import versions
from sdfnet.geometry.solids import Sphere
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.scene import Material, Sampling
from tests.data.stored_examples import MESH, PROVENANCE, SAMPLES, TRAJECTORY, small_mesh, small_samples, small_trajectory, write_all


def test_a_trajectory_comes_back_to_the_bit() -> None:
    written = small_trajectory()
    store.write_trajectory(TRAJECTORY, written, PROVENANCE)
    read = store.read_trajectory(TRAJECTORY)
    for name in ("times", "displacements"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), strict=True)
    assert read.mesh.digest == written.mesh.digest
    assert read.time_step == written.time_step
    assert read.report == written.report


def test_distances_come_back_to_the_bit() -> None:
    written = small_samples()
    store.write_distances(SAMPLES, written, PROVENANCE)
    read = store.read_distances(SAMPLES)
    for name in ("points", "distances", "kept", "near_points", "near_distances"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), strict=True)
    np.testing.assert_array_equal(read.box.lower, written.box.lower)
    np.testing.assert_array_equal(read.box.upper, written.box.upper)


def test_a_mesh_comes_back_to_the_bit_and_its_medit_copy_to_rounding() -> None:
    store.write_mesh(MESH, small_mesh(), PROVENANCE)
    assert store.read_mesh(MESH).digest == small_mesh().digest
    medit = store.read_mesh(MESH.with_suffix(".mesh"))
    np.testing.assert_allclose(medit.nodes, small_mesh().nodes, atol=1e-15)  # printed with 16 digits
    np.testing.assert_array_equal(medit.tets, small_mesh().tets)


def test_every_array_says_its_unit_and_every_file_its_version_and_provenance() -> None:
    write_all()
    units = {"nodes": "m", "tets": "node index", "times": "s", "displacements": "m", "frames": "m", "box": "m", "points": "m", "near_points": "m"}
    units |= {"distances": "m, negative inside", "near_distances": "m, negative inside", "kept": "point index"}
    for path, kind in ((TRAJECTORY, "trajectory"), (SAMPLES, "distances")):
        with h5py.File(path) as file:
            assert file.attrs["format"] == "sdfnet"
            assert file.attrs["kind"] == kind
            assert file.attrs["version"] == store.FORMAT_VERSION
            assert len(file) > 3
            for name, values in file.items():
                assert values.attrs["unit"] == units[name]
    for provenance in (store.read_provenance(TRAJECTORY), store.read_provenance(SAMPLES), store.read_mesh_provenance(MESH)):
        assert provenance == {**PROVENANCE, "versions": versions()}


def test_a_key_follows_settings_and_their_kind_and_nothing_else() -> None:
    key = store.key_of(Sampling(), "abc")
    assert key == store.key_of(Sampling(), "abc")
    assert len({key, store.key_of(Sampling(seed=1), "abc"), store.key_of(Sampling(), "abd"), store.key_of("abc", Sampling())}) == 4
    assert store.key_of({"a": Pinned(), "b": Material()}) == store.key_of({"b": Material(), "a": Pinned()})


def test_settings_are_described_as_plain_json_with_their_kind() -> None:
    assert store.described(Sphere(radius=0.1, cells=4)) == {"kind": "Sphere", "radius": 0.1, "cells": 4}
    assert json.loads(json.dumps(store.described({"foot": Pinned()})))["foot"]["region"]["normal"] == [0.0, 0.0, 1.0]


def test_the_key_of_an_effect_from_outside_follows_the_code_of_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    code = "from dataclasses import dataclass\nHOW_MUCH = {}\n@dataclass(frozen=True)\nclass Tickle:\n    strength: float = 1.0\n"
    keys = []
    for name, number in (("ticklish", 1), ("ticklish", 1), ("ticklish", 2)):
        (tmp_path / f"{name}.py").write_text(code.format(number))
        monkeypatch.delitem(sys.modules, name, raising=False)
        importlib.invalidate_caches()
        tickle = importlib.import_module(name).Tickle()
        assert store.described(tickle)["strength"] == 1.0
        keys.append(store.key_of(tickle))
    assert keys[0] == keys[1] != keys[2], "a constant beside the class is its code too"
