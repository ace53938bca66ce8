"""The errors a user may see: one sentence that says what is wrong, where, and what to do."""

import re
from typing import Any

_LONGEST_REASON = 300
_NO_NAME = re.compile(r"[^\s/\\,]{300,}")
"""A word that is longer than any part of a path: content of a file, not its name."""


def in_short(reason: object) -> str:
    """Return what is said of something on one line, cut off where it is long, as it is with the content of a file."""
    text = " ".join(str(reason).split())
    return text if len(text) <= _LONGEST_REASON else f"{text[:_LONGEST_REASON]}..."


class FreeGeoError(Exception):
    """The work failed for a reason we understand (exit code 1); endless words in the sentence are cut off."""

    def __init__(self, sentence: object = "") -> None:
        super().__init__(_NO_NAME.sub(lambda word: f"{word[0][:80]}...", str(sentence)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let an error pass from a worker to another process as it is, whatever its own arguments were."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class UserError(FreeGeoError, ValueError):
    """The request cannot be carried out as asked; the sentence says what to change (exit code 2)."""


class DamagedError(FreeGeoError):
    """A file that freegeo wrote, or one like it, whose content is not what it has to be."""

    def __init__(self, path: object, reason: object, advice: str) -> None:
        self.reason = in_short(reason)
        super().__init__(f"{path}: damaged file ({self.reason}). {advice}")


class PartialResultError(FreeGeoError):
    """Everything was written but for what the sentence names (exit code 3)."""


class DivergedError(FreeGeoError):
    """An adaptation whose loss or gradient is not finite, or has grown beyond recovery: it has no result."""


class LostFolderError(FreeGeoError):
    """An output folder that was removed or changed while a command was writing there: the command ends at once."""


class NoEvidenceError(FreeGeoError):
    """A scene whose matches between photos prove no cameras, where these are to be learned from."""
