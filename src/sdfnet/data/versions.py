"""The versions of what made a result."""

import importlib.metadata
import platform

RECORDED_PACKAGES = (
    "sdfnet", "torch", "lightning", "pytorch_optimizer", "hydra-core", "numpy", "scipy", "scikit-fem", "pytetwild", "warp-lang", "trimesh", "vtk", "h5py",
)  # fmt: skip
OPTIONAL_PACKAGES = ("libigl", "open3d", "rtree")  # which studies of what accuracy costs compare with


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that results depend on, of optional ones where they are installed."""
    optional = [name for name in OPTIONAL_PACKAGES if any(importlib.metadata.distributions(name=name))]
    return {"python": platform.python_version(), **{name: importlib.metadata.version(name) for name in (*RECORDED_PACKAGES, *optional)}}
