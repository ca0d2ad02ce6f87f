"""What one look found: a grade, what it is about, and a sentence that ends in the cure where one is needed."""

from typing import NamedTuple

OK, NOTE, BAD = "ok", "note", "BAD"


class Finding(NamedTuple):
    """`ok`, `note` (something optional is missing, or will go wrong) or `BAD` (the fleet cannot run as it should)."""

    grade: str
    what: str
    sentence: str
