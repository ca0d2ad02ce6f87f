"""Wrong inputs: each is answered in one last line with what was found and expected, and ends with exit code 2."""

import json
import logging
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import exit_code

from fleet import cli
from fleet.commands.offline.completion import SCRIPTS, verb_parsers
from fleet.process import logs
from gateway import __main__ as gateway
from twin_worker import __main__ as twin_worker
from viewer import __main__ as viewer

ROOT = Path(__file__).resolve().parents[2]
MAINS = {"fleet": cli.main, "gateway": gateway.main, "twin_worker": twin_worker.main, "viewer": viewer.main}
ANSWERS = {  # command line -> part of the last line
    "fleet": "found no verb, expected approve, assess, calibrate",
    "fleet statsu": "found no verb 'statsu', expected approve, assess, calibrate",
    "fleet STATUS": "did you mean status?",
    "fleet --verison": "found no option '--verison', expected one of the usage above; did you mean --version?",
    "fleet status --routr x": "found no option '--routr', expected one of the usage above; did you mean --router?",
    "fleet status --router": "--router: found no value, expected one; write it after --router",
    "fleet status --json=yes": "--json: found value 'yes', expected none; leave it out",
    "fleet status extra": "found 'extra' behind all arguments, expected nothing more; leave it out",
    "fleet status --watch --json": "--watch: found --json too, expected only one; drop one",
    "fleet status --router nonsense": "--router: found 'nonsense', expected e.g. tcp/127.0.0.1:7447",
    "fleet status --router tcp/127.0.0.1:1": "router tcp/127.0.0.1:1: no response; start `zenohd` or `fleet up`",
    "fleet status --config nosuch.toml": "--config: found no file 'nosuch.toml', expected one such as deploy",
    "fleet status --config folder": "--config: found a folder 'folder', expected a TOML file; name a file in it",
    "gateway --config nosuch.toml": "--config: found no file 'nosuch.toml', expected one such as deploy/fleet.toml",
    "fleet up --link ftp:127.0.0.1:21": "--link: found 'ftp:127.0.0.1:21', expected udpin, udpout, udpbcast",
    "fleet up --link udpin:127.0.0.1": "--link: found 'udpin:127.0.0.1', expected udpin:HOST:PORT",
    "fleet up --forward serail:/dev/ttyUSB0": "--forward: found 'serail:/dev/ttyUSB0', expected udpin, udpout",
    "fleet up --keys nosuch.txt": "--keys: found no file 'nosuch.txt', expected a file of keys; check the path",
    "fleet status --config bad.toml": "--config: found invalid TOML in bad.toml",
    "fleet up --uavs x": "--uavs: found 'x', expected a whole number; correct it",
    "fleet up --uavs 0": "--uavs: found 0, expected 1 to 250 aircraft",
    "fleet up --re x": "--re: found an abbreviation of --replay, --results, expected the name of an option",
    "fleet up --uav 8": "--uav: found an abbreviation of --uavs, expected the name of an option; write it in full",
    "fleet calibrate text.txt --ou x": "--ou: found an abbreviation of --out, expected the name of an option",
    "fleet --vers": "--vers: found an abbreviation of --version, expected the name of an option; write it in full",
    "fleet up --windd 3": "found no option '--windd', expected one of the usage above; see --help",
    "fleet fly --windd 3": "found no option '--windd', expected one of the usage above; did you mean --wind?",
    "fleet fly --wind nan": "--wind: found 'nan', expected a number; correct it",
    "fleet up --autopilot ardu": "--autopilot: found 'ardu', expected ardupilot, px4; did you mean ardupilot?",
    "fleet up --replay nosuch.tlog": "--replay: found no file 'nosuch.tlog', expected a recording; check the path",
    "fleet up --replay folder": "--replay: found a folder 'folder', expected a recording; name a file in it",
    "fleet up --for nan": "--for: found 'nan', expected a number; correct it",
    "fleet up --for inf": "--for: found 'inf', expected a number; correct it",
    "fleet up --port 99999": "--port: found 99999, expected 1 to 65535; choose another port",
    "fleet up --mavlink 127.0.0.1": "--mavlink: found '127.0.0.1', expected HOST:PORT such as 127.0.0.1:14550",
    "fleet up --areas nosuch.json": "--areas: found no file 'nosuch.json', expected a GeoJSON file; check the path",
    "twin_worker --uavs 0-1 --areas text.txt": "text.txt: found JSON is malformed",
    "fleet up --terrain nosuch.tif": "--terrain: found no file 'nosuch.tif', expected a raster file; check the path",
    "fleet up --imagery folder": "--imagery: found a folder 'folder', expected a raster file; name a file in it",
    "fleet up --fault nosuch": "--fault: found 'nosuch', expected one of actuator_lag",
    "fleet up --baseline nosuch.json": "--baseline: found no file 'nosuch.json', expected a model from",
    "fleet up --baseline 3=nosuch.json": "--baseline: found no file 'nosuch.json', expected a model from",
    "fleet up --replay text.txt --speed fast": "--speed: found 'fast', expected a number above 0 or max; write e.g. 4",
    "fleet up --baseline 3=folder": "--baseline: found a folder 'folder', expected a model from",
    "fleet up --summary folder": "--summary: found a folder 'folder', expected a file; name a file in it",
    "fleet up --summary nosuch/x.json": "--summary: found no folder 'nosuch', expected one; create it first",
    "fleet up --summary text.txt/x.json": (
        "--summary: found a file in place of the folder 'text.txt', expected one; create it first"
    ),
    "fleet up --columns nosuch": "--columns: found no file 'nosuch', expected a TOML file or one of alfa, px4",
    "fleet up --columns folder": "--columns: found a folder 'folder', expected a TOML file or one of alfa, px4",
    "fleet up --mission nosuch": "--mission: found no file 'nosuch', expected a QGC WPL 110 file; check the path",
    "fleet replay text.txt --params nosuch": "--params: found no file 'nosuch', expected a parameter file",
    "fleet replay nosuch": "FILE: found no file 'nosuch', expected a recording; check the path",
    "fleet fly --tlog folder": "--tlog: found a folder 'folder', expected a file; name a file in it",
    "fleet fly --tlog nosuch/x.tlog": "--tlog: found no folder 'nosuch', expected one; create it first",
    "fleet record nosuch/x.parauav": "FILE: found no folder 'nosuch', expected one; create it first",
    "fleet record folder": "FILE: found a folder 'folder', expected a file; name a file in it",
    "fleet whatif 7 --items nosuch": "--items: found no file 'nosuch', expected a QGC WPL 110 file; check the path",
    "fleet diagnose nosuch --model text.txt": "FLIGHT: found no file 'nosuch', expected a recording; check the path",
    "fleet diagnose text.txt --against folder": "--against: found a folder 'folder', expected a recording",
    "fleet diagnose text.txt --airframe nosuch": "--airframe: found no file 'nosuch', expected an airframe TOML, a",
    "fleet diagnose text.txt --json folder": "--json: found a folder 'folder', expected a file; name a file in it",
    "fleet diagnose text.txt --report text.txt": "--report: found the file 'text.txt', expected a folder; name another",
    "fleet calibrate nosuch --out x.json": "NOMINAL: found no file 'nosuch', expected a recording; check the path",
    "fleet calibrate text.txt --out folder": "--out: found a folder 'folder', expected a file; name a file in it",
    "fleet calibrate text.txt --out x --airframe folder": "--airframe: found a folder 'folder', expected an airframe",
    "fleet calibrate text.txt --out x --json nosuch/y": "--json: found no folder 'nosuch', expected one; create it",
    "fleet assess text.txt --json folder": "--json: found a folder 'folder', expected a file; name a file in it",
    "fleet assess text.txt --out text.txt": "--out: found the file 'text.txt', expected a folder; name another",
    "fleet prove --json folder": "--json: found a folder 'folder', expected a file; name a file in it",
    "fleet prove --report text.txt": "--report: found the file 'text.txt', expected a folder; name another",
    "fleet prove --inject nosuch": "--inject: found no file 'nosuch', expected a recording; check the path",
    "fleet inspect text.txt --json folder": "--json: found a folder 'folder', expected a file; name a file in it",
    "fleet inspect text.txt --plot nosuch/x.png": "--plot: found no folder 'nosuch', expected one; create it first",
    "fleet paper identify nosuch": "FILE: found no file 'nosuch', expected a recording; check the path",
    "fleet paper predict --json folder": "--json: found a folder 'folder', expected a file; name a file in it",
    "fleet paper identify --out text.txt": "--out: found the file 'text.txt', expected a folder; name another",
    "twin_worker --baseline folder": "--baseline: found a folder 'folder', expected a model from `fleet calibrate`",
    "twin_worker --baseline 3=nosuch": "--baseline: found no file 'nosuch', expected a model from `fleet calibrate`",
    "twin_worker --airframe nosuch": "--airframe: found no file 'nosuch', expected a TOML file or one of aerosonde",
    "twin_worker --config folder": "--config: found a folder 'folder', expected a TOML file; name a file in it",
    "viewer --config nosuch": "--config: found no file 'nosuch', expected one such as deploy/fleet.toml; check",
    "viewer --map folder": "--map: found a folder 'folder', expected an MBTiles or PMTiles file; name a file in it",
    "fleet diagnose text.txt --model nosuch.json": "--model: found no file 'nosuch.json', expected a model from",
    "fleet router --listen nowhere": "--listen: found 'nowhere', expected e.g. tcp/127.0.0.1:7447",
    "fleet inspect": "FILE: found none, expected at least one recording; name one",
    "fleet inspect nosuch.tlog": "FILE: found no file 'nosuch.tlog', expected a recording; check the path",
    "fleet inspect folder": "FILE: found a folder 'folder', expected a recording; name a file in it",
    "fleet inspect text.txt --mission folder": (
        "--mission: found a folder 'folder', expected a QGC WPL 110 file; name a file in it"
    ),
    "fleet assess text.txt --params folder": (
        "--params: found a folder 'folder', expected a parameter file; name a file in it"
    ),
    "fleet assess folder": "FILE: found a folder 'folder', expected a recording; name a file in it",
    "fleet calibrate text.txt": "--out: found none, expected one; add it",
    "fleet export": "FILE: found none, expected one; add it",
    "fleet export x.txt": "FILE: found 'x.txt', expected a name that ends in .geojson, .kml, .mcap, .rrd; rename it",
    "fleet export nosuch/x.kml": "FILE: found no folder 'nosuch', expected one; create it first",
    "fleet export x.kml --for -1": "--for: found -1 s, expected 0 (until Ctrl-C) or more; change it",
    "fleet export x.kml --from nosuch.parauav": "--from: found no file 'nosuch.parauav', expected a recording",
    "fleet export x.kml --from text.txt": "--from: found 'text.txt', expected a .parauav recording",
    "fleet export x.kml --from text.txt --for 3": "--for: found --from too, expected only one",
    "fleet export x.kml --uavs 9-3": "--uavs: found '9-3', expected a range of ids such as 0-49",
    "fleet whatif seven": "uav: found 'seven', expected a whole number; correct it",
    "fleet whatif 7 --wind=nan,2": "--wind: found 'nan,2', expected two numbers, north and east; write e.g.",
    "fleet whatif 7 --param WP_RADIUS=nan": "--param: found 'WP_RADIUS=nan', expected NAME=VALUE",
    "fleet whatif 7 --wind 3": "--wind: found '3', expected two numbers, north and east; write e.g. --wind=6,-2",
    "fleet schema predictoin": "did you mean prediction?",
    "fleet effects nosuch": "found 'nosuch', expected an effect such as actuator_stuck",
    "fleet completion tcsh": "shell: found 'tcsh', expected bash, zsh, fish",
    "gateway --link udp:": "--link: found 'udp:', expected udpin, udpout, udpbcast, tcpin, tcp, serial, replay",
    "gateway --link upd:127.0.0.1:14550": "each with an address behind a :; did you mean udpin?",
    "gateway --link udpin:127.0.0.1": "expected udpin:HOST:PORT; write e.g. udpin:127.0.0.1:14550",
    "gateway --link serial:/dev/ttyUSB0:x7:0": "expected serial:PATH:BAUD; write e.g. serial:/dev/ttyUSB0:57600",
    "gateway --record text.txt": "--record: found the file 'text.txt', expected a folder; name another",
    "gateway --record text.txt/x": "--record: found the file 'text.txt', expected a folder; name another",
    "gateway --keys nosuch": "--keys: found no file 'nosuch', expected a file of keys; check the path",
    "gateway --audit folder": "--audit: found a folder 'folder', expected a file; name a file in it",
    "gateway --record-budget lots --record r": "--record-budget: found 'lots', expected a size such as 500M or 10G",
    "gateway --keys folder": "--keys: found a folder 'folder', expected a file of keys; name a file in it",
    "gateway --most-uavs 0": "--most-uavs: found 0, expected at least 1; write e.g. 250",
    "twin_worker --uavs 9-3": "--uavs: found '9-3', expected a range of ids such as 0-49; write the lower one first",
    "twin_worker --separation 5": "--separation: found '5', expected two distances in m, e.g. 50,20; correct it",
    "twin_worker --omega nan": "--omega: found 'nan', expected a number; correct it",
    "twin_worker --processes 0": "--processes: found 0, expected 1 to 256; set one per core",
    "viewer --map no.mbtiles": "--map: found no file 'no.mbtiles', expected an MBTiles or PMTiles file; check the path",
    "viewer --map text.txt": "text.txt: found no tile archive, expected raster tiles",
    "fleet up --map folder": "--map: found a folder 'folder', expected an MBTiles or PMTiles file; name a file in it",
    "viewer --terrain nosuch.tif": "--terrain: found no file 'nosuch.tif', expected a raster file; check the path",
    "viewer --imagery folder": "--imagery: found a folder 'folder', expected a raster file; name a file in it",
    "viewer --terrain text.txt": "text.txt: found no readable raster",
    "viewer --port 0": "--port: found 0, expected 1 to 65535; choose another port",
    "viewer --ligth": "found no option '--ligth', expected one of the usage above; did you mean --light?",
}
ARGPARSE = re.compile(
    r"invalid choice|invalid \w+ value|unrecognized|the following arguments|\bargument -|error:|Errno"
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A folder to work in; the commands set up logging, which is undone."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.txt").write_text("no recording\n")
    (tmp_path / "bad.toml").write_text("[router\n")
    monkeypatch.chdir(tmp_path)
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.mark.parametrize("line", ANSWERS)
def test_a_wrong_input_is_answered_in_one_line(line: str, folder: None, capsys: pytest.CaptureFixture[str]) -> None:
    program, *words = line.split()
    code = exit_code(lambda: MAINS[program](words))
    said = capsys.readouterr().err
    last = logs.strip_time(said.splitlines()[-1])
    verb = f"fleet {words[0]}" if program == "fleet" and words and words[0] in cli.command_modules() else program
    assert code == 2 and last.startswith(f"{verb}: ") and ANSWERS[line] in last
    assert not ARGPARSE.search(said) and "Traceback" not in said and len(last) < 1000
    if "usage" in said.partition("\n")[0]:  # that of the verb
        assert said.startswith(f"usage: {verb} ")


def test_the_page_of_wrong_inputs_has_every_answer() -> None:
    """Made by `python -m tests.bench.wrong_inputs > docs/wrong-inputs.md`."""
    rows = dict(re.findall(r"^\| `(.*?)` \| (.*) \| 2 \|$", (ROOT / "docs" / "wrong-inputs.md").read_text(), re.M))
    assert list(rows) == list(ANSWERS)
    assert [line for line, answer in ANSWERS.items() if answer not in rows[line].replace("\\|", "|")] == []


def test_version_and_help_of_all_commands_and_verbs_import_nothing_heavy() -> None:
    """What takes time is imported when a command runs; the modules are counted, as seconds are the machine's."""
    code = """
import json, sys
from importlib import import_module
from fleet.cli import command_modules
lines = [("fleet.cli", verb, "--help") for verb in command_modules()]
for name in ("fleet.cli", "gateway.__main__", "twin_worker.__main__", "viewer.__main__"):
    lines += [(name, "--version"), (name, "--help")]
heavy, codes = {}, []
for name, *words in lines:
    try:
        import_module(name).main(words)
    except SystemExit as left:
        codes.append(left.code)
    for name in ("numba", "scipy", "zenoh", "viser", "pymavlink", "jsbsim", "matplotlib", "rerun"):
        if name in sys.modules:
            heavy.setdefault(name, words)
print(json.dumps([len(lines), codes, heavy]), file=sys.stderr)
"""
    line = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True)
    count, codes, heavy = json.loads(done.stderr)
    assert codes == [0] * count and count == 8 + len(cli.command_modules()) and heavy == {}
    assert done.stdout.count("\nparauav ") == 4 and done.stdout.count("examples:") == count - 4


def test_completion_offers_all_verbs_and_their_options() -> None:
    verbs = verb_parsers()
    assert set(verbs) == set(cli.command_modules())
    for script in SCRIPTS.values():
        text = script(verbs)
        assert all(name in text for name in verbs) and "autopilot" in text
    ask = 'source /dev/stdin; COMP_WORDS=(fleet {}); COMP_CWORD={}; _fleet; echo "${{COMPREPLY[@]}}"'
    for words, n, expected in (("st", 1, "status"), ("status --r", 2, "--router"), ("completion z", 2, "zsh")):
        done = subprocess.run(
            ["bash", "-c", ask.format(words, n)],
            input=SCRIPTS["bash"](verbs),
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.strip() == expected and done.stderr == ""
