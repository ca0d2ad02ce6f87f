"""What is in deploy/ is well-formed, and every command line in it is one that the commands take."""

import ast
import base64
import contextlib
import json
import os
import re
import shlex
import shutil
import subprocess
import tomllib
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
import zenoh
from conftest import ROOT, unused_port
from test_readme import MAINS, commands, understood

from docs import generate
from fleet.access.roles import ROLES, ROUTER_ROLE
from fleet.bus.codec import decode, encode
from fleet.bus.session import connect
from fleet.contract import FleetState, GatewayCounters, Prediction, Status
from gateway import status as gateway
from tests.bench.security.site import REAL, Site, make_papers, routed, zenohd
from tests.bench.security.trying import until
from tests.support.examples import EXAMPLES
from tests.support.memory_bus import MemoryBus
from twin_worker.service import work_rates as twin_worker

DEPLOY = ROOT / "deploy"
README = (DEPLOY / "README.md").read_text()
IMAGES = {"parauav", "eclipse/zenoh:1.10.2"}
OURS = {"gateway", "twin_worker", "viewer"}


def manifests() -> list[dict[str, Any]]:
    files = sorted((DEPLOY / "k8s").glob("*.yaml"))
    return [one for file in files for one in yaml.safe_load_all(file.read_text())]


def composed() -> dict[str, Any]:
    return yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]


def containers() -> Iterator[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Give name, container and pod of every Deployment."""
    for one in manifests():
        if one["kind"] == "Deployment":
            pod = one["spec"]["template"]["spec"]
            for container in pod["containers"]:
                yield one["metadata"]["name"], container, pod


def units() -> dict[str, dict[str, list[str]]]:
    """Give the settings of every service unit, by name."""
    out: dict[str, dict[str, list[str]]] = {}
    for file in sorted((DEPLOY / "systemd").glob("*.service")):
        found: dict[str, list[str]] = {}
        for name, value in re.findall(r"^(\w+)=(.*)$", file.read_text(), re.M):
            found.setdefault(name, []).append(value)
        out[file.name] = found
    return out


def started(unit: dict[str, list[str]]) -> str:
    """Give what a unit starts, its instance 0-49, the variables as the unit itself sets them."""
    (line,) = unit["ExecStart"]
    told = dict(re.findall(r'"(\w+)=([^"]*)"', " ".join(unit["Environment"])))
    return re.sub(r"\$(\w+)", lambda found: told[found[1]], line.replace("%i", "0-49"))


def lines() -> list[str]:
    """Give every command line of ours in deploy/."""
    out = [shlex.join(service["command"]) for service in composed().values()]
    out += [shlex.join([*container.get("command", []), *container["args"]]) for _, container, _ in containers()]
    out += [started(unit) for unit in units().values()]
    out += re.findall(r'^    \w+="(.*)"$', README, re.M)
    return out


def ours() -> list[str]:
    out = [line.rpartition("/.venv/bin/")[2] for line in lines()]
    out = [line for line in out if line.split()[0] in MAINS]
    gateway, worker = re.findall(r'^    (?:GATEWAY|WORKER)="(.*)"$', README, re.M)
    return sorted({*out, f"gateway {gateway}", f"twin_worker {worker}", *commands(README)})


@pytest.mark.parametrize("line", ours())
def test_every_command_line_is_one_that_the_command_takes(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert understood(line, monkeypatch)


def test_each_process_is_started_by_each_way() -> None:
    found = [line.split()[0] for line in ours()]
    assert all(found.count(name) >= 3 for name in OURS)
    assert {container["image"] for _, container, _ in containers()} == IMAGES
    assert {service["image"] for service in composed().values()} == IMAGES


# --- containers ------------------------------------------------------------------------------------------------------


def test_probes_and_ports_are_those_of_the_commands() -> None:
    for name, container, pod in containers():
        assert pod["automountServiceAccountToken"] is False
        if container["image"] != "parauav":
            continue
        ports = {port["name"]: port["containerPort"] for port in container["ports"]}
        where = {"metrics": "--metrics=0.0.0.0:9100", "mavlink": "--link=udpin:0.0.0.0:14550"}
        assert all(where[port] in container["args"] for port in ports if port in where), name
        for probe in ("startupProbe", "livenessProbe"):
            assert container[probe]["httpGet"]["port"] in ports
        assert pod["terminationGracePeriodSeconds"] >= 30


def test_every_pod_passes_where_a_cluster_restricts_them() -> None:
    for name, container, pod in containers():
        told = pod["securityContext"]
        assert told["runAsNonRoot"] and told["seccompProfile"] == {"type": "RuntimeDefault"}, name
        assert told["fsGroup"] == told["runAsGroup"] != 0  # or nobody in there may read the keys
        assert container["securityContext"] == {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}


def test_each_pod_has_the_certificates_of_its_own_role_alone() -> None:
    for name, container, pod in containers():
        (secret,) = [volume["secret"] for volume in pod["volumes"] if "secret" in volume]
        assert secret["secretName"] == name and name.removeprefix("parauav-") in (*ROLES, ROUTER_ROLE)
        assert secret["defaultMode"] == 0o440
        assert "/etc/parauav/certificates" in [mount["mountPath"] for mount in container["volumeMounts"]]


def test_services_select_pods_that_exist() -> None:
    labels = [one["spec"]["template"]["metadata"]["labels"] for one in manifests() if one["kind"] == "Deployment"]
    services = [one for one in manifests() if one["kind"] == "Service"]
    assert len(services) == 3 and all(service["spec"]["selector"] in labels for service in services)
    deployments = {name: container for name, container, _ in containers()}
    for service in services:
        ports = [port["name"] for port in deployments[service["spec"]["selector"]["app"]]["ports"]]
        assert all(port["targetPort"] in ports for port in service["spec"]["ports"])


def test_workers_scale_by_replicas_and_a_new_one_joins_before_an_old_one_goes() -> None:
    (worker,) = [one for one in manifests() if one["metadata"]["name"] == "parauav-worker"]
    assert worker["spec"]["replicas"] > 1
    assert worker["spec"]["strategy"]["rollingUpdate"] == {"maxSurge": 1, "maxUnavailable": 0}


def test_a_router_in_a_container_is_not_process_1_which_would_not_hear_sigterm() -> None:
    assert composed()["router"]["init"] is True
    (pod,) = [pod for name, _, pod in containers() if name == "parauav-router"]
    assert pod["shareProcessNamespace"] is True


def test_secrets_that_are_made_are_those_that_are_mounted() -> None:
    (made,) = re.findall(r"^#   for role in (.*); do$", (DEPLOY / "kustomization.yaml").read_text(), re.M)
    mounted = {
        volume["secret"]["secretName"] for *_, pod in containers() for volume in pod["volumes"] if "secret" in volume
    }
    assert {f"parauav-{role}" for role in made.split()} == mounted


def test_the_readme_makes_certificates_where_its_configuration_looks_for_them() -> None:
    text = (ROOT / "README.md").read_text()
    (folder,) = re.findall(r"certificates\.sh all (\S+) ", text)
    (config,) = set(re.findall(r"--config (deploy/\S+)", text))
    told = tomllib.loads((ROOT / config).read_text())["router"]
    assert ROOT / folder == (ROOT / config).parent / told["certificates"]


def test_keys_get_into_no_commit_and_no_image() -> None:
    ignored = subprocess.run(["git", "check-ignore", "deploy/certificates/ca.key"], cwd=ROOT, check=False)
    assert ignored.returncode == 0
    kept = (ROOT / ".dockerignore").read_text().split("\n**\n")[1].splitlines()
    copied = re.findall(r"^COPY (.*) \S+$", (DEPLOY / "Dockerfile").read_text(), re.M)
    assert kept[-1] == "**/__pycache__"
    assert {line.removeprefix("!") for line in kept[:-1]} == {name for names in copied for name in names.split()}


def test_files_that_are_mounted_or_named_exist() -> None:
    for service in composed().values():
        for volume in service["volumes"]:
            source = volume.split(":")[0]
            assert source == "./certificates" or (DEPLOY / source).is_file(), source
    custom = yaml.safe_load((DEPLOY / "kustomization.yaml").read_text())
    assert sorted(custom["resources"]) == sorted(f"k8s/{file.name}" for file in (DEPLOY / "k8s").glob("*.yaml"))
    named = [file.rpartition("=")[2] for made in custom["configMapGenerator"] for file in made["files"]]
    assert all((DEPLOY / name).is_file() for name in named)
    for name in re.findall(r"`([\w./-]+\.(?:json5|toml|sh|yaml|py))`", README):
        assert (DEPLOY / name).is_file() or (ROOT / name).is_file(), name


def test_metrics_worth_an_alarm_are_told_by_exactly_these_names() -> None:
    worker = twin_worker.counters(lambda: EXAMPLES[FleetState], MemoryBus())
    link = gateway.counters(lambda: (EXAMPLES[GatewayCounters], [EXAMPLES[Status]]))
    told = {sample.name for metric in (*worker(), *link()) for sample in metric.samples}
    named = set(re.findall(r"`(parauav_\w+)`", README))
    assert len(named) > 4 and named <= told, named - told


def test_kubectl_takes_the_manifests() -> None:
    if shutil.which("kubectl") is None:
        pytest.skip("no kubectl on the path")
    done = subprocess.run(["kubectl", "kustomize", str(DEPLOY)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    made = list(yaml.safe_load_all(done.stdout))
    (policy,) = [one for one in made if one["kind"] == "NetworkPolicy"]
    (let_in,) = policy["spec"]["ingress"][0]["from"]
    pods = [one["spec"]["template"]["metadata"]["labels"] for one in made if one["kind"] == "Deployment"]
    assert all(let_in["podSelector"]["matchLabels"].items() <= labels.items() for labels in pods)


def test_the_image_is_made_of_what_is_there() -> None:
    text = (DEPLOY / "Dockerfile").read_text()
    for names in re.findall(r"^COPY (.*) \S+$", text, re.M):
        assert all((ROOT / name).exists() for name in names.split())
    (code,) = re.findall(r'^RUN python -c "(.*)" \\$', text, re.M)
    assert [node.module for node in ast.parse(code).body if isinstance(node, ast.ImportFrom)] == [
        "fleet.telemetry.mavlink.warm",
        "twin_worker.service.warm_up",
    ]


# --- units -----------------------------------------------------------------------------------------------------------


def test_systemd_takes_the_units(tmp_path: Path) -> None:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze on the path")
    for file in (DEPLOY / "systemd").iterdir():
        text = re.sub(r"^ExecStart=\S+", "ExecStart=/bin/true", file.read_text(), flags=re.M)
        (tmp_path / file.name.replace("@", "@0-49")).write_text(text)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == 5
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", *(f"./{name}" for name in names)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_units_end_politely_and_never_give_up() -> None:
    for unit in units().values():
        assert unit["KillSignal"] == ["SIGTERM"] and int(unit["TimeoutStopSec"][0]) >= 30
        assert unit["StartLimitIntervalSec"] == ["0"] and unit["User"] == ["parauav"]


# --- the router ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["zenohd.json5", "zenohd-site.json5", "rest.json5"])
def test_zenoh_takes_the_configuration_and_zenohd_starts_with_it(name: str, tmp_path: Path) -> None:
    assert zenoh.Config.from_file(str(DEPLOY / name))
    if name == "rest.json5":
        return
    if (program := zenohd()) is None:
        pytest.skip("no zenohd (PARAUAV_ZENOHD, the path, ~/.cargo/bin)")
    papers, port = make_papers(tmp_path / "certificates", "127.0.0.1"), unused_port()
    text = (DEPLOY / name).read_text().replace("/etc/parauav/certificates", str(papers))
    file = tmp_path / name
    file.write_text(re.sub(r"(0\.0\.0\.0|127\.0\.0\.1):7447", f"127.0.0.1:{port}", text))
    log = tmp_path / "log"
    with log.open("wb") as out, subprocess.Popen([program, "-c", str(file)], stdout=out, stderr=out) as child:
        try:
            assert until(lambda: b"can be reached at" in log.read_bytes() or child.poll() is not None)
        finally:
            with contextlib.suppress(ProcessLookupError):
                child.terminate()
        assert b"can be reached at" in log.read_bytes() and b"ERROR" not in log.read_bytes()


def fetched(where: str, method: str = "GET", body: bytes | None = None) -> str:
    """Ask over HTTP; empty where nobody answers yet."""
    request = urllib.request.Request(where, data=body, method=method)
    with contextlib.suppress(OSError), urllib.request.urlopen(request, timeout=5.0) as reply:
        return reply.read().decode()
    return ""


def test_predictions_answer_over_http_and_what_it_is_asked_to_write_is_dropped(tmp_path: Path) -> None:
    folder = os.environ.get("PARAUAV_ZENOH_PLUGINS")
    if folder is None or (program := zenohd()) is None:
        pytest.skip("no zenohd, or no folder of its REST plug-in in PARAUAV_ZENOH_PLUGINS; deploy/README.md makes it")
    papers, port, http = make_papers(tmp_path / "certificates", "127.0.0.1"), unused_port(), unused_port()
    text = (DEPLOY / "rest.json5").read_text().replace("127.0.0.1:7447", f"127.0.0.1:{port}")
    (tmp_path / "rest.json5").write_text(text.replace("/etc/parauav/certificates", str(papers)))
    command = [program, "-c", str(tmp_path / "rest.json5"), "--plugin-search-dir", folder]
    command += ["--rest-http-port", f"127.0.0.1:{http}"]
    where = f"http://127.0.0.1:{http}/parauav"
    heard: list[bytes] = []
    with contextlib.ExitStack() as held:
        site = held.enter_context(routed(REAL, Site(f"tls/127.0.0.1:{port}", papers)))
        quiet = subprocess.DEVNULL
        child = held.enter_context(subprocess.Popen(command, stdout=quiet, stderr=quiet))
        held.callback(child.terminate)
        worker, tools = (held.enter_context(connect(site.entry(role))) for role in ("worker", "tools"))
        worker.answer(Prediction, lambda *_: [(EXAMPLES[Prediction], None)])
        tools.subscribe_raw(Prediction, lambda payload, *_: heard.append(payload))
        found: list[dict[str, str]] = []

        def asked() -> bool:
            found.extend(json.loads(fetched(f"{where}/*/prediction?horizon=30;step=30") or "[]"))
            return bool(found)

        assert until(asked) and found[0]["key"] == "parauav/7/prediction"
        assert decode(Prediction, base64.b64decode(found[0]["value"])) == EXAMPLES[Prediction]

        def told() -> bool:
            fetched(f"{where}/7/prediction", "PUT", b"forged")
            worker.publish(EXAMPLES[Prediction])
            return len(heard) > 3

        assert until(told) and set(heard) == {encode(EXAMPLES[Prediction])}


# --- the Grafana dashboard -------------------------------------------------------------------------------------------

DASHBOARD = json.loads((ROOT / "deploy" / "grafana.json").read_text())


def served() -> dict[str, set[str]]:
    """Every metric that gateway and worker serve, with its labels."""
    families = [*generate.gateway_families(), *generate.worker_families()]
    samples = [sample for family in families for sample in family.samples]
    return {sample.name: set(sample.labels) for sample in samples}


def test_every_metric_of_the_dashboard_is_served_with_the_labels_it_uses() -> None:
    known = served()
    targets = [target for panel in DASHBOARD["panels"] for target in panel["targets"]]
    named = {name for target in targets for name in re.findall(r"\bparauav_\w+", target["expr"])}
    assert named <= known.keys() and len(named) > 20
    for target in targets:
        (names, labels) = re.findall(r"\bparauav_\w+", target["expr"]), re.findall(r"{{(\w+)}}", target["legendFormat"])
        labels += re.findall(r"by \((\w+)\)", target["expr"])
        assert set(labels) <= set.union({"instance"}, *(known[name] for name in names)), target["expr"]
        counters = [name for name in names if name.endswith("_total")]
        assert all(re.search(rf"(rate|increase)\({name}\[", target["expr"]) for name in counters), target["expr"]


def test_the_panels_of_the_dashboard_do_not_overlap_and_have_a_data_source() -> None:
    taken: set[tuple[int, int]] = set()
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        cells = {
            (place["x"] + i, place["y"] + j) for i in range(place["w"]) for j in range(place["h"])
        }  # a grid of 24 columns
        assert not cells & taken and max(x for x, _ in cells) < 24
        taken |= cells
        assert panel["datasource"]["uid"] == "${datasource}" and panel["title"]
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])
    assert [entry["type"] for entry in DASHBOARD["templating"]["list"]] == ["datasource"]
