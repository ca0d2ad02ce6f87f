"""Options that name a file or folder: checked when the command line is parsed, before anything is started."""

import os
from argparse import ArgumentTypeError
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

RECORDING = "a recording"
MODEL = "a model from `fleet calibrate`"


def check_file(option: str, path: Path | str, expected: str = RECORDING) -> None:
    """Check that an input is a file that can be read.

    Raises:
        ValueError: when it does not exist, is a folder or is unreadable; the text names the option.
    """
    if problem := _unreadable(Path(path), expected):
        raise ValueError(f"{option}: {problem}")


def input_file(expected: str = RECORDING, shipped: str = "") -> Callable[[str], Path]:
    """Return the `type` of an argument that names a file to read, or a TOML file shipped in the package `shipped`."""

    def checked(text: str) -> Path:
        names = _shipped_names(shipped) if shipped else []
        choice = f"{expected} or one of {', '.join(names)}" if names else expected
        if text not in names and (problem := _unreadable(Path(text), choice)):
            raise ArgumentTypeError(problem)
        return Path(text)

    return checked


airframe_file = input_file("a TOML file", "fleet.airframes")
airframe_card = input_file("an airframe TOML, a JSON card", "fleet.airframes")


def model_of(text: str) -> str:
    """Check `[ID=]MODEL`, a reference model of one aircraft or of all; `type` of an argument.

    Raises:
        ArgumentTypeError: when the model is no readable file; argparse shows the text.
    """
    uav, _, path = text.partition("=")
    input_file(MODEL)(path if uav.isdecimal() else text)
    return text


def output_file(text: str) -> Path:
    """Check that a file can be written; `type` of an argument.

    Raises:
        ArgumentTypeError: when it is a folder, its folder is missing, or one may not write; argparse shows the text.
    """
    path, parent = Path(text), Path(text).absolute().parent
    if path.is_dir():
        raise ArgumentTypeError(f"found a folder {text!r}, expected a file; name a file in it")
    if not parent.is_dir():
        absence = "a file in place of the" if parent.exists() else "no"
        raise ArgumentTypeError(f"found {absence} folder {str(path.parent)!r}, expected one; create it first")
    _check_writable(path if path.exists() else parent)
    return path


def output_folder(text: str) -> Path:
    """Check that a folder can be written or created, with its parents; `type` of an argument.

    Raises:
        ArgumentTypeError: when a file is in its place, or one may not write; argparse shows the text.
    """
    path = Path(text)
    existing = next(one for one in (path, *path.parents) if one.exists())
    if not existing.is_dir():
        raise ArgumentTypeError(f"found the file {str(existing)!r}, expected a folder; name another")
    _check_writable(existing)
    return path


def audit_file(text: str) -> Path:
    """Check that a file can be written or created, with its folders; `type` of an argument.

    Raises:
        ArgumentTypeError: when it is a folder, or one may not write; argparse shows the text.
    """
    output_folder(str(Path(text).parent))
    return output_file(text) if Path(text).absolute().parent.exists() else Path(text)


def _shipped_names(package: str) -> list[str]:
    spec = find_spec(package)  # without importing it
    folders = (spec.submodule_search_locations or ()) if spec is not None else ()
    return sorted(path.stem for folder in folders for path in Path(folder).glob("*.toml"))


def _unreadable(path: Path, expected: str) -> str:
    """Describe why an input cannot be read; empty when it can."""
    if path.is_dir():
        return f"found a folder {str(path)!r}, expected {expected}; name a file in it"
    if not path.exists():
        return f"found no file {str(path)!r}, expected {expected}; check the path"
    if not os.access(path, os.R_OK):
        return f"found no permission to read {str(path)!r}, expected {expected}; change it with chmod"
    return ""


def _check_writable(path: Path) -> None:
    if not os.access(path, os.W_OK):
        raise ArgumentTypeError(f"found no permission to write {str(path)!r}, expected it; choose another place")
