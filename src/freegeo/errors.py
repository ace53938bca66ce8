"""The errors a user may see: one sentence that says what is wrong, where, and what to do."""


class FreeGeoError(Exception):
    """The work failed for a reason we understand (exit code 1)."""


class UserError(FreeGeoError, ValueError):
    """The request cannot be carried out as asked; the sentence says what to change (exit code 2)."""


class PartialResultError(FreeGeoError):
    """Everything was written but for what the sentence names (exit code 3)."""


class DivergedError(FreeGeoError):
    """An adaptation whose loss or gradient is not finite, or has grown beyond recovery: it has no result."""


class LostFolderError(FreeGeoError):
    """An output folder that was removed or changed while a command was writing there: the command ends at once."""


class NoEvidenceError(FreeGeoError):
    """A scene whose matches between photos prove no cameras, where these are to be learned from."""
