"""Result of one check: grade, subject, and a sentence that ends with the remedy when one is needed."""

from typing import NamedTuple

OK, NOTE, BAD = "ok", "note", "BAD"


class CheckResult(NamedTuple):
    """Grade `ok`, `note` (optional part missing, or future problem) or `BAD` (the fleet cannot run correctly)."""

    grade: str
    what: str
    sentence: str
