"""Errors and warnings: one family, each also the builtin it refines."""

__all__ = [
    "AnalysisWarning",
    "CalibrationError",
    "DamagedFileWarning",
    "DeviceError",
    "ExposureWarning",
    "LayoutError",
    "LayoutWarning",
    "PdavisError",
    "PdavisWarning",
    "RecordingError",
    "WeightsError",
    "WindowWarning",
]


class PdavisError(Exception):
    """Root of the errors that this library defines."""


class RecordingError(PdavisError, OSError):
    """Raised when a recording is not what it says; names file, byte and finding."""


class DeviceError(RecordingError):
    """Raised when a camera or a stream cannot be opened, or is gone."""


class LayoutError(PdavisError, ValueError):
    """Raised for an impossible polarizer layout, or if two sources disagree on it."""


class CalibrationError(PdavisError, ValueError):
    """Raised when a calibration does not belong to the recording or cannot be read."""


class WeightsError(PdavisError, ValueError):
    """Raised when the weights of a network are damaged, foreign or do not fit."""


class PdavisWarning(UserWarning):
    """Root of the warnings that this library gives, once per recording."""


class LayoutWarning(PdavisWarning):
    """The polarizer layout was assumed, not known."""


class DamagedFileWarning(PdavisWarning):
    """A part of a file could not be read; the rest was delivered."""


class ExposureWarning(PdavisWarning):
    """Exposure times are missing, uncertain or too long for what was asked."""


class AnalysisWarning(PdavisWarning):
    """A measurement was asked for where its conditions do not hold."""


class WindowWarning(PdavisWarning):
    """Events are summed over windows too long for what they show."""
