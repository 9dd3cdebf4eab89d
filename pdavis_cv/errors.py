"""Errors and warnings; each error is also a subclass of the fitting builtin."""
from pdavis_cv._text import MOST_TEXT, shown


class PdavisError(Exception):
    """Base class of this library's errors."""

    def __str__(self) -> str:
        return shown(super().__str__(), MOST_TEXT)


class RecordingError(PdavisError, OSError):
    """Raised for a damaged or unknown recording; names file, byte and finding."""


class DeviceError(RecordingError):
    """Raised when a camera or a stream cannot be opened, or was disconnected."""


class LayoutError(PdavisError, ValueError):
    """Raised for an impossible polarizer layout, or if two sources disagree on it."""


class CalibrationError(PdavisError, ValueError):
    """Raised when a calibration does not belong to the recording or cannot be read."""


class WeightsError(PdavisError, ValueError):
    """Raised when the weights of a network are damaged, unknown or do not fit."""


class PdavisWarning(UserWarning):
    """Base class of this library's warnings, which are issued once per recording."""

    def __str__(self) -> str:
        return shown(super().__str__(), MOST_TEXT)


class LayoutWarning(PdavisWarning):
    """The polarizer layout is unknown and a default was assumed."""


class DamagedFileWarning(PdavisWarning):
    """A part of a file could not be read; the rest was read."""


class ExposureWarning(PdavisWarning):
    """Exposure times are missing, uncertain or too long."""


class AnalysisWarning(PdavisWarning):
    """The conditions of a measurement do not hold."""


class WindowWarning(PdavisWarning):
    """Events are summed over windows that are too long for the motion."""
