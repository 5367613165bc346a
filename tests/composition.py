"""What a command line composes, for tests."""

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from sdfnet.cli.entry import register
from sdfnet.plugins import frozen, shipped
from sdfnet.scene import Dataset


def composed(name: str, *overrides: str) -> DictConfig:
    """The configuration of a command; `register` comes first."""
    with initialize_config_dir(str(shipped("conf").resolve()), version_base="1.3"):
        return compose(name, list(overrides))


def composed_dataset(*overrides: str) -> Dataset:
    """The dataset that `prepare` would be given."""
    register("prepare")
    found = frozen(composed("prepare", *overrides)).dataset
    assert isinstance(found, Dataset)
    return found
