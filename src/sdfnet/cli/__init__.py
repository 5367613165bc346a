"""The commands: each composes the library's stages and holds nothing that a notebook would miss."""

from sdfnet.cli.entry import cost, evaluate, prepare, train, verify

__all__ = ["cost", "evaluate", "prepare", "train", "verify"]
