"""The errors that a user can cause or cure. Each message says what was expected, what was found and what to do."""


class SdfnetError(Exception):
    """Base of every error that sdfnet raises on purpose; the commands print it without a traceback."""


class ConfigurationError(SdfnetError):
    """A setting is unknown, of the wrong type, or contradicts another."""


class GeometryError(SdfnetError):
    """A surface or tet mesh cannot be what the stage needs: missing, open, inverted, empty."""


class PhysicsError(SdfnetError):
    """A scene cannot be simulated as asked: unstable step, a load on nothing, nothing held."""


class StoreError(SdfnetError):
    """A file is missing, truncated, foreign, or of another version."""


class TrainingError(SdfnetError):
    """Training cannot go on: a value is not finite, or a checkpoint belongs to another model."""


class ReconstructionError(SdfnetError):
    """A field has no surface inside the grid, or cannot be turned into one."""
