"""The files of deploy/: systemd and promtool accept them, the examples load, and only metrics that exist are used."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from plr.controlplane.cli.__main__ import main as plr
from plr.controlplane.config.controlplane import load_config as load_controlplane_config
from plr.controlplane.core.control.control import ControlCore
from plr.controlplane.observe.fleet_metrics import Fleet
from plr.controlplane.observe.metrics import Metrics
from plr.protos.base.host_port import split_host_port
from plr.protos.model.ids import NodeName, Role
from plr.protos.program.exit_codes import EXIT_USAGE
from plr.protos.trust.identity import Identity, IdentityRole, RevocationList
from plr.sidecar.config.sidecar import SidecarConfig, load_config
from plr.sidecar.control.revocations import RevocationState
from plr.sidecar.core.control.session import ControlStats
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.observe.metrics import MetricSources, SidecarCollector
from tests.support.free_ports import free_port

if TYPE_CHECKING:
    from collections.abc import Iterator

DEPLOY = Path(__file__).parents[2] / "deploy"
LISTS = {1: RevocationList(3, 0.0, 1.0, b"")}
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))
DASHBOARDS = sorted((DEPLOY / "grafana").glob("*.json"))
PROMETHEUS = DEPLOY / "prometheus"
RULES = PROMETHEUS / "plr-rules.yml"
RULE_TESTS = sorted((PROMETHEUS / "tests").glob("*.yml"))
RUNBOOK = DEPLOY.parent / "docs" / "operate" / "runbook.md"
RECORDED = r"\w+:\w+:\w+"
"""Names of what is recorded: level, metric, what was done to it."""

MAX_EXPOSURE_TENTHS = 20
"""systemd-analyze's scale of 0 to 10.0, in tenths: a service without any hardening has 96."""

CONTRACT: dict[str, set[str]] = {
    "plr_requests_total": {"service", "outcome"},
    "plr_request_duration_seconds": {"service"},
    "plr_path_rtt_seconds": {"interface", "peer"},
    "plr_path_up": {"interface", "peer"},
    "plr_path_wins_total": {"interface", "peer", "service"},
    "plr_duplicate_responses_total": set(),
    "plr_datagrams_total": {"interface", "direction", "kind"},
    "plr_datagrams_dropped_total": {"interface", "reason"},
    "plr_bytes_total": {"interface", "direction"},
    "plr_mapping_version": set(),
    "plr_nacks_total": {"resource"},
    "plr_predicted_miss_probability": {"robot", "service"},
    "plr_observed_miss_ratio": {"robot", "service"},
    "plr_solve_duration_seconds": set(),
    "plr_connected_sidecars": {"role"},
}
"""The metrics that users may rely on, with their labels."""

BEYOND_CONTRACT: dict[str, set[str]] = {
    "plr_control_plane_connected": set(),
    "plr_certificate_expiry_timestamp_seconds": set(),
    "plr_refused_connections_total": {"reason"},
    "plr_registrations_refused_total": {"reason"},
    "plr_revocation_list_number": {"ca"},
    "plr_revocation_list_age_seconds": {"ca"},
    "plr_revocation_list_max_age_seconds": set(),
    "plr_revocation_lists_too_old": set(),
    "plr_fleet_series_left_out": set(),
    "plr_leases_postponed_total": set(),
    "plr_loop_cpu_seconds_total": set(),
    "plr_robot_interface_changes_total": {"robot", "interface"},
    "plr_robot_interface_fault": {"robot", "interface", "fault"},
    "plr_robot_interface_info": {"robot", "interface", "carrier"},
    "plr_robot_interface_up": {"robot", "interface"},
    "plr_robot_mapping_synced": {"robot"},
    "plr_robot_path_rtt_seconds": {"robot", "interface", "server"},
    "plr_robot_path_up": {"robot", "interface", "server"},
    "plr_robot_requests_missed_total": {"robot", "service"},
    "plr_robot_requests_total": {"robot", "service"},
    "plr_robot_service_paths": {"robot", "service"},
    "plr_robot_servers": {"robot"},
    "plr_server_robots": {"server", "path"},
    "plr_server_service_unanswered": {"server", "service"},
    "plr_server_service_up": {"server", "service"},
    "plr_service_unmet": {"service"},
    "plr_sidecar_certificate_expiry_timestamp_seconds": {"sidecar", "role"},
    "plr_sidecar_gone_info": {"sidecar", "role", "why"},
    "plr_sidecar_info": {"name", "role", "version"},
    "plr_sidecar_gone_timestamp_seconds": {"sidecar", "role"},
    "plr_sidecar_up": {"sidecar", "role"},
    "plr_target_miss_probability": {"robot", "service"},
    "plr_tls_files_refused": set(),
}
"""Further metrics of the programs that the rules and dashboards use."""

METRICS = CONTRACT | BEYOND_CONTRACT

SCRAPE_LABELS = {"instance", "job", "le"}
"""Labels that Prometheus itself and histograms add."""


def run(*command: str | Path, cwd: Path | None = None) -> str:
    """Output of a command that must succeed."""
    assert shutil.which(str(command[0])), f"{command[0]} is missing: run deploy/dev/setup.sh"
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.fixture
def host(tmp_path: Path) -> Path:
    """Root of a host that has Debian's units, ours, and programs at the paths that ours name."""
    shutil.copytree("/usr/lib/systemd/system", tmp_path / "usr/lib/systemd/system", symlinks=True)
    (tmp_path / "lib").symlink_to("usr/lib")
    etc = tmp_path / "etc/systemd/system"
    etc.mkdir(parents=True)
    for unit in UNITS:
        shutil.copy(unit, etc)
        programs = re.findall(r"^Exec\w+=(\S+)", unit.read_text(), re.MULTILINE)
        assert programs
        for program in programs:
            path = tmp_path / program.lstrip("/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch(mode=0o755)
    return tmp_path


def test_there_is_a_unit_for_each_program() -> None:
    assert [unit.name for unit in UNITS] == ["plr-controlplane.service", "plr-sidecar.service"]


def test_systemd_understands_the_units(host: Path) -> None:
    names = [unit.name for unit in UNITS]
    # An unknown key is only warned of, hence the empty output.
    assert run("systemd-analyze", "verify", "--man=no", f"--root={host}", *names) == ""


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_the_units_expose_little(unit: Path) -> None:
    run("systemd-analyze", "security", "--offline=true", f"--threshold={MAX_EXPOSURE_TENTHS}", "--no-pager", unit)


def settings(unit: str, key: str) -> list[str]:
    text = (DEPLOY / "systemd" / f"{unit}.service").read_text()
    return re.findall(rf"^{key}=(.*)$", text, re.MULTILINE)


def test_only_the_sidecar_has_a_capability_and_only_that_one() -> None:
    for key in ("AmbientCapabilities", "CapabilityBoundingSet"):
        assert settings("plr-sidecar", key) == ["CAP_NET_RAW"]
        assert settings("plr-controlplane", key) == [""]


@pytest.mark.parametrize("unit", [unit.stem for unit in UNITS])
def test_the_units_restart_on_failure_for_ever(unit: str) -> None:
    assert settings(unit, "Type") == ["notify"]
    assert settings(unit, "Restart") == ["on-failure"]
    assert settings(unit, "StartLimitIntervalSec") == ["0"]


def test_a_wrong_configuration_stops_the_control_plane_only() -> None:
    # The sidecar also says 2 when an address is not there yet, which may appear by and by.
    assert settings("plr-controlplane", "RestartPreventExitStatus") == [str(EXIT_USAGE)]
    assert settings("plr-sidecar", "RestartPreventExitStatus") == []


def test_the_account_of_the_units_is_made(tmp_path: Path) -> None:
    (tmp_path / "etc").mkdir()
    run("systemd-sysusers", f"--root={tmp_path}", DEPLOY / "sysusers.d" / "plr.conf")
    accounts = [line.split(":")[0] for line in (tmp_path / "etc/passwd").read_text().splitlines()]
    assert accounts == ["plr"]
    for unit in UNITS:
        assert settings(unit.stem, "User") == accounts


def certified(role: Role) -> Identity:
    return Identity(NodeName(f"{role.value}-7"), IdentityRole(role.value), 1, 0.0, 1.0)


def sidecar_config(role: Role) -> SidecarConfig:
    return load_config(DEPLOY / "config" / f"sidecar-{role.value}.yaml", lambda _: certified(role))


@pytest.mark.parametrize("role", list(Role))
def test_the_example_configurations_of_the_sidecar_load(role: Role) -> None:
    config = sidecar_config(role)
    assert config.role is role
    # Where the unit lets the sidecar write.
    assert config.state_dir == Path("/var/lib") / settings("plr-sidecar", "StateDirectory")[0]


def test_the_example_configuration_of_the_control_plane_loads() -> None:
    config = load_controlplane_config(DEPLOY / "config" / "controlplane.yaml")
    ports = [split_host_port(address)[1] for address in (config.listen, *config.stun_listen)]
    assert min(ports) > 1023, "the unit has no capability for lower ports"


def test_the_example_configurations_belong_together() -> None:
    control = load_controlplane_config(DEPLOY / "config" / "controlplane.yaml")
    sidecars = [sidecar_config(role) for role in Role]
    assert {split_host_port(address)[1] for sidecar in sidecars for address in sidecar.control_plane} == {
        split_host_port(control.listen)[1]
    }
    listen = {"plr-sidecar": sidecars[0].metrics_listen, "plr-controlplane": control.metrics_listen}
    scrape = yaml.safe_load((DEPLOY / "prometheus" / "prometheus.yml").read_text())["scrape_configs"]
    for job in scrape:
        address = listen[job["job_name"]]
        assert address
        for target in job["static_configs"][0]["targets"]:
            assert split_host_port(target)[1] == split_host_port(address)[1]


def test_prometheus_accepts_its_configuration() -> None:
    output = run("promtool", "check", "config", "prometheus.yml", cwd=DEPLOY / "prometheus")
    assert "1 rule files found" in output


@pytest.mark.audit("ops-12")
def test_prometheus_accepts_an_agents_configuration_which_names_the_node() -> None:
    run("promtool", "check", "config", "--agent", "agent.yml", cwd=PROMETHEUS)
    config = yaml.safe_load((PROMETHEUS / "agent.yml").read_text())
    (job,) = config["scrape_configs"]
    (node,) = job["static_configs"]
    assert job["job_name"] == "plr-sidecar"
    assert node["targets"] == [sidecar_config(Role.ROBOT).metrics_listen]
    assert node["labels"]["instance"] not in node["targets"]


@pytest.mark.audit("ops-12")
def test_prometheus_knows_where_the_runbook_is_and_tells_the_alertmanager_no_label_of_that() -> None:
    config = yaml.safe_load((PROMETHEUS / "prometheus.yml").read_text())
    assert config["global"]["external_labels"]["plr_docs"].startswith("https://")
    assert {"regex": "plr_docs", "action": "labeldrop"} in config["alerting"]["alert_relabel_configs"]


@pytest.mark.audit("ops-12")
@pytest.mark.parametrize("path", RULE_TESTS, ids=lambda path: path.stem)
def test_alerts_fire_when_they_should_and_only_then(path: Path) -> None:
    run("promtool", "test", "rules", path.name, cwd=PROMETHEUS / "tests")


@pytest.mark.audit("ops-12")
def test_each_alert_is_tried() -> None:
    cases = [case for path in RULE_TESTS for case in yaml.safe_load(path.read_text())["tests"]]
    fired = {rule["alertname"] for case in cases for rule in case.get("alert_rule_test", ()) if rule.get("exp_alerts")}
    assert fired == {rule["alert"] for rule in alerts()}


@pytest.mark.audit("ops-12")
def test_each_alert_has_a_section_in_the_runbook_and_each_section_an_alert() -> None:
    sections = re.findall(r"^### (\w+)$", RUNBOOK.read_text(), re.MULTILINE)
    assert sorted(sections) == sorted(rule["alert"] for rule in alerts())
    for rule in alerts():
        page, _, anchor = rule["annotations"]["runbook_url"].partition("#")
        assert page == "{{ $externalLabels.plr_docs }}/operate/" + RUNBOOK.name
        assert anchor == rule["alert"].lower()
    texts = re.split(r"^### ", RUNBOOK.read_text(), flags=re.MULTILINE)[1:]
    assert [text.split()[0] for text in texts if not re.search(r"Meaning.*Look at.*Do\.", text, re.DOTALL)] == []


@pytest.mark.audit("ops-12")
def test_the_runbook_names_only_commands_that_exist() -> None:
    for command in set(re.findall(r"`plr ((?:ca )?[a-z]+)", RUNBOOK.read_text())):
        with pytest.raises(SystemExit) as ended:
            plr([*command.split(), "--help"])
        assert ended.value.code == 0, command


@pytest.mark.audit("ops-12")
def test_the_alertmanager_accepts_its_configuration() -> None:
    run("amtool", "check-config", "alertmanager.yml", cwd=PROMETHEUS)
    config = yaml.safe_load((PROMETHEUS / "alertmanager.yml").read_text())
    names = {rule["alert"] for rule in alerts()}
    for inhibits in config["inhibit_rules"]:
        for matcher in (*inhibits["source_matchers"], *inhibits["target_matchers"]):
            found = re.fullmatch(r'alertname=~?"(.+)"', matcher)
            assert found is not None
            for pattern in found[1].split("|"):
                assert any(re.fullmatch(pattern, name) for name in names), pattern


@pytest.mark.audit("ops-12")
def test_what_a_stranger_can_cause_keeps_back_nothing() -> None:
    config = yaml.safe_load((PROMETHEUS / "alertmanager.yml").read_text())
    causes = re.compile('alertname="(PlrControlPlaneOverloaded|PlrConnectionsRefused)"')
    assert not [rule for rule in config["inhibit_rules"] if causes.match(rule["source_matchers"][0])]


@pytest.fixture(scope="module")
def alertmanager(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a real one with the shipped configuration; nobody hears what it notifies."""
    program = shutil.which("prometheus-alertmanager")
    assert program, "prometheus-alertmanager is missing: run deploy/dev/setup.sh"
    address = f"127.0.0.1:{free_port()}"
    options = ["--storage.path", str(tmp_path_factory.mktemp("alertmanager")), "--cluster.listen-address="]
    command = [
        program,
        "--config.file",
        str(PROMETHEUS / "alertmanager.yml"),
        "--web.listen-address",
        address,
        *options,
    ]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as process:
        try:
            give_up_at = time.monotonic() + 30.0
            while not ask(f"http://{address}/-/ready"):
                assert process.poll() is None
                assert time.monotonic() < give_up_at
                time.sleep(0.05)
            yield f"http://{address}/api/v2/alerts"
        finally:
            process.terminate()


def ask(url: str, sent: object = None) -> bytes:
    """What it answers; nothing if it does not."""
    body = None if sent is None else json.dumps(sent).encode()
    request = urllib.request.Request(url, body, {"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(request, timeout=10.0) as answer:
            return bytes(answer.read()) or b" "
    except urllib.error.URLError:
        return b""


Labels = dict[str, str]


@pytest.mark.audit("ops-12")
@pytest.mark.parametrize(
    ("cause", "kept_back", "told"),
    [
        (
            {"alertname": "PlrRobotNoPath", "robot": "r1"},
            [{"alertname": "PlrMissesAboveTarget", "robot": "r1", "service": "/s"}],
            [
                {"alertname": "PlrMissesAboveTarget", "robot": "r2", "service": "/s"},
                {"alertname": "PlrMappingStale", "robot": "r1"},
            ],
        ),
        (
            {"alertname": "PlrMissesAboveTarget", "robot": "r3", "service": "/s"},
            [{"alertname": "PlrMissesAbovePrediction", "robot": "r3", "service": "/s"}],
            [{"alertname": "PlrMissesAbovePrediction", "robot": "r3", "service": "/other"}],
        ),
        (
            {"alertname": "PlrCertificateEnded", "sidecar": "r1"},
            [{"alertname": "PlrCertificateEnding", "sidecar": "r1"}],
            [{"alertname": "PlrCertificateEnding", "sidecar": "r2"}],
        ),
        # What follows from these lasts seconds, or is another alert's business.
        ({"alertname": "PlrCarrierDown", "carrier": "c"}, [], [{"alertname": "PlrRobotUnreachable", "robot": "r4"}]),
        (
            {"alertname": "PlrServerDown", "server": "a"},
            [],
            [
                {"alertname": "PlrServerLostService", "server": "b", "service": "/s"},
                {"alertname": "PlrServerAnswersNobody", "server": "b", "service": "/s"},
                {"alertname": "PlrServiceUnserved", "service": "/s"},
            ],
        ),
        ({"alertname": "PlrControlPlaneOverloaded"}, [], [{"alertname": "PlrMappingStale", "robot": "r4"}]),
        # Last, as it keeps back most.
        (
            {"alertname": "PlrControlPlaneDown"},
            [
                {"alertname": "PlrServerLostService", "server": "a", "service": "/s"},
                {"alertname": "PlrServerAnswersNobody", "server": "a", "service": "/s"},
                {"alertname": "PlrNotConnected", "sidecar": "a"},
                {"alertname": "PlrRobotUnreachable", "robot": "r5"},
            ],
            [
                {"alertname": "PlrServiceUnserved", "service": "/s"},
                {"alertname": "PlrRequestsFailed", "sidecar": "r1", "service": "/s"},
                {"alertname": "PlrRevocationListTooOld", "sidecar": "r1"},
            ],
        ),
    ],
    ids=lambda labels: labels["alertname"] if isinstance(labels, dict) else "",
)
def test_an_alert_keeps_back_what_follows_from_it_and_nothing_else(
    alertmanager: str, cause: Labels, kept_back: list[Labels], told: list[Labels]
) -> None:
    """In a real Alertmanager."""
    severities = {rule["alert"]: rule["labels"]["severity"] for rule in alerts()}
    sent = [labels | {"severity": severities[labels["alertname"]]} for labels in (cause, *kept_back, *told)]
    assert ask(alertmanager, [{"labels": labels} for labels in sent])
    wanted = {labels["alertname"] + str(sorted(labels.items())) for labels in sent[1 : 1 + len(kept_back)]}

    def found() -> tuple[bool, set[str]]:
        known = [one for one in json.loads(ask(alertmanager)) if one["labels"] in sent]
        complete = len(known) == len(sent) and all(one["status"]["state"] != "unprocessed" for one in known)
        kept = [one["labels"] for one in known if one["status"]["inhibitedBy"]]
        return complete, {labels["alertname"] + str(sorted(labels.items())) for labels in kept}

    give_up_at = time.monotonic() + 30.0
    while found() != (True, wanted) and time.monotonic() < give_up_at:
        time.sleep(0.05)
    assert found() == (True, wanted)
    over = [{"labels": labels, "endsAt": "2020-01-01T00:00:00Z"} for labels in sent]
    assert ask(alertmanager, over)


def alerts() -> list[dict[str, Any]]:
    return [rule for rule in rules() if "alert" in rule]


def rules() -> list[dict[str, Any]]:
    return [rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]


def panels(dashboard: Path) -> Iterator[dict[str, Any]]:
    for panel in json.loads(dashboard.read_text())["panels"]:
        yield from panel.get("panels", ())
        if panel["type"] != "row":
            yield panel


def dashboard_expressions(dashboard: Path) -> list[str]:
    return [target["expr"] for panel in panels(dashboard) for target in panel["targets"]]


def expressions() -> list[str]:
    return [rule["expr"] for rule in rules()] + [e for path in DASHBOARDS for e in dashboard_expressions(path)]


def family(name: str) -> str:
    """Name of the metric that a series belongs to."""
    stripped = re.sub(r"_(bucket|sum|count)$", "", name)
    return stripped if stripped in METRICS else name


def exported_metrics() -> dict[str, set[str]]:
    """What the two programs export, with labels."""
    identity = certified(Role.ROBOT)
    sidecar = SidecarCollector(
        MetricSources(
            name="robot-7",
            role="robot",
            version="0",
            engine=EngineStats,
            links=lambda: (),
            interfaces=dict,
            unmet=tuple,
            control=ControlStats,
            connected=lambda: False,
            bridge=None,
            state_failures=dict,
            certificate=lambda: identity,
            files_refused=lambda: False,
            revocations=lambda: RevocationState(LISTS, frozenset(), 86_400.0),
            local_refused=lambda: {},
        )
    )
    control = Metrics()
    control.watch_fleet(lambda: Fleet((), (), {}, 0.0, 0.0))
    control.own_certificate(identity, LISTS)
    config = load_controlplane_config(DEPLOY / "config" / "controlplane.yaml")
    control.update(ControlCore(config.settings(), version_epoch=1, now=0.0), (), 0)
    families = [*sidecar.collect(), *control.registry.collect()]
    suffixes = {"counter": "_total", "info": "_info"}
    exported: dict[str, set[str]] = {}
    for family in families:
        labels = exported.setdefault(family.name + suffixes.get(family.type, ""), set())
        labels.update(getattr(family, "_labelnames", ()), *(sample.labels for sample in family.samples))
        labels.discard("le")
    return exported


def test_the_programs_export_the_contract() -> None:
    exported = exported_metrics()
    assert {name: exported.get(name) for name in METRICS} == METRICS


@pytest.mark.parametrize("expression", expressions())
def test_expressions_use_only_metrics_and_labels_that_exist(expression: str) -> None:
    recorded = {rule["record"] for rule in rules() if "record" in rule}
    assert set(re.findall(RECORDED, expression)) <= recorded
    labels = SCRAPE_LABELS
    if re.search(RECORDED, expression):
        labels = labels | {label for of in METRICS.values() for label in of}
    expression = re.sub(RECORDED, "", expression)
    names = {family(name) for name in re.findall(r"\bplr_\w+", expression)}
    assert names <= METRICS.keys()
    assert set(re.findall(r"\bprocess_\w+", expression)) <= exported_metrics().keys()
    # Also those that label_replace makes, which is by its third argument.
    made = set(re.findall(r',\s*"(\w+)",\s*"[^"]*",\s*"\w*"', expression))
    known = labels.union(made, *(METRICS[name] for name in names))
    compared = re.findall(r'(\w+)\s*(?:=~|!~|!=|=)\s*"', expression)
    grouped = [
        label for labels in re.findall(r"\b(?:by|on|without)\s*\(([^)]*)\)", expression) for label in labels.split(",")
    ]
    assert {label.strip() for label in compared + grouped if label.strip()} <= known


def test_the_dashboards_show_every_metric_of_the_contract() -> None:
    shown = {family(name) for e in expressions() for name in re.findall(r"\bplr_\w+", re.sub(RECORDED, "", e))}
    assert shown == METRICS.keys()


@pytest.mark.parametrize("dashboard", DASHBOARDS, ids=lambda path: path.stem)
def test_prometheus_understands_the_expressions_of_the_dashboards(dashboard: Path, tmp_path: Path) -> None:
    variables = {"$__rate_interval": "1m", "$__range": "1h", "$instance": ".*", "$service": ".*"}
    records = []
    for number, expression in enumerate(dashboard_expressions(dashboard)):
        for variable, value in variables.items():
            expression = expression.replace(variable, value)
        assert "$" not in expression
        records.append({"record": f"panel:{number}", "expr": expression})
    assert records
    file = tmp_path / "rules.yml"
    file.write_text(yaml.safe_dump({"groups": [{"name": "dashboard", "rules": records}]}))
    run("promtool", "check", "rules", file)


@pytest.mark.parametrize("dashboard", DASHBOARDS, ids=lambda path: path.stem)
def test_the_dashboards_are_laid_out_without_overlap(dashboard: Path) -> None:
    taken: set[tuple[int, int]] = set()
    identities = []
    for panel in json.loads(dashboard.read_text())["panels"]:
        identities.append(panel["id"])
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken, panel["title"]
        assert max(x for x, _ in cells) < 24, "Grafana's grid has 24 columns"
        taken |= cells
    assert len(set(identities)) == len(identities)
