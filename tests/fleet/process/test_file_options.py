"""Options that name a file or folder: permissions, names of shipped files, and what is accepted."""

import os
from argparse import ArgumentTypeError
from pathlib import Path

import pytest

from fleet.process import file_options
from fleet.process.file_options import (
    airframe_file,
    audit_file,
    check_file,
    input_file,
    model_of,
    output_file,
    output_folder,
)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in with a file, a folder, and one of each without any permission."""
    for name in ("folder", "closed"):
        (tmp_path / name).mkdir()
    for name in ("text.txt", "closed.txt"):
        (tmp_path / name).write_text("x")
    monkeypatch.chdir(tmp_path)
    allowed = os.access
    monkeypatch.setattr(  # root may do everything
        file_options.os, "access", lambda path, mode: "closed" not in Path(path).name and allowed(path, mode)
    )
    return tmp_path


@pytest.mark.parametrize(
    ("check", "text", "answer"),
    [
        (input_file(), "closed.txt", "found no permission to read 'closed.txt', expected a recording"),
        (airframe_file, "glider", "found no file 'glider', expected a TOML file or one of aerosonde, "),
        (model_of, "7=closed.txt", "found no permission to read 'closed.txt'"),
        (output_file, "closed.txt", "found no permission to write"),
        (output_file, "closed/new.json", "found no permission to write"),
        (output_file, "text.txt/new.json", "found a file in place of the folder 'text.txt'"),
        (output_folder, "closed/new/newer", "found no permission to write"),
        (output_folder, "text.txt/new", "text.txt', expected a folder; name another"),
        (audit_file, "text.txt/new/a.jsonl", "text.txt', expected a folder; name another"),
        (audit_file, "folder", "found a folder 'folder', expected a file"),
    ],
)
def test_a_path_that_cannot_be_used_is_refused(check, text: str, answer: str, place: Path) -> None:
    with pytest.raises(ArgumentTypeError, match=answer):
        check(text)


def test_a_path_that_can_be_used_is_returned(place: Path) -> None:
    assert input_file()("text.txt") == Path("text.txt") and airframe_file("skywalker") == Path("skywalker")
    assert output_file("text.txt") == Path("text.txt") and output_file("folder/new.json") == Path("folder/new.json")
    assert output_folder("folder") == Path("folder") and output_folder("new/newer") == Path("new/newer")
    assert audit_file("new/a.jsonl") == Path("new/a.jsonl") and model_of("7=text.txt") == "7=text.txt"
    assert not (place / "new").exists()
    check_file("--replay", "text.txt")
    with pytest.raises(ValueError, match=r"--replay: found no permission to read 'closed.txt', expected a recording"):
        check_file("--replay", "closed.txt")
