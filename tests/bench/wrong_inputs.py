"""Wrong inputs, the answer of each, and its exit code: `python -m tests.bench.wrong_inputs > docs/wrong-inputs.md`.

The inputs are those of `tests/fleet/test_wrong_inputs.py`, which holds the answers. Each is given to a process of its
own in a folder with `folder/`, `text.txt` and `bad.toml`; the answer is the last line on standard error.
"""

import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from fleet.process.logs import strip_time
from tests.fleet.test_wrong_inputs import ANSWERS

ROOT = Path(__file__).resolve().parents[2]
HEAD = """# Wrong inputs

Every command checks its options before it starts anything. A wrong one is answered in one line that names the subject,
what was found, what is expected, and the remedy; the exit code is 2. A command that was interrupted ends with 130, one
whose work failed with 1. In this table `folder` is a folder, `text.txt` a text file and `bad.toml` not TOML; `nosuch`
does not exist. `python -m tests.bench.wrong_inputs > docs/wrong-inputs.md` renews it.
"""
MODULES = {"fleet": "fleet.cli"}


def answer(line: str, folder: str) -> tuple[str, int]:
    """Return the last line on standard error and the exit code of a command."""
    program, *words = line.split()
    command = [sys.executable, "-m", MODULES.get(program, program), *words]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, timeout=120, check=False)
    return strip_time(done.stderr.rstrip().rpartition("\n")[2]), done.returncode


def main() -> int:
    """Print the table as Markdown; exit code 1 where an answer is not the tested one."""
    wrong = 0
    print(HEAD)
    print("| Input | Answer | Exit code |\n| --- | --- | --- |")
    with TemporaryDirectory() as folder:
        (Path(folder) / "folder").mkdir()
        (Path(folder) / "text.txt").write_text("no recording\n")
        (Path(folder) / "bad.toml").write_text("[router\n")
        for line, expected in ANSWERS.items():
            text, code = answer(line, folder)
            wrong += code != 2 or expected not in text
            print(f"| `{line}` | {text.replace('|', chr(92) + '|')} | {code} |", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
