"""The layout that people find their way by: layers without an upward import, unit tests where their sources lie."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UNIT = ROOT / "tests" / "unit"
TOPS = ("sidecar", "controlplane", "protos", "lab", "bench", "deploy")

PLANTED = {
    "sidecar/core/wire/frame.py": ("plr.sidecar.core.message.partial", "the sidecar's core in layers"),
    "sidecar/core/robot/measure/measurements.py": (
        "plr.sidecar.core.robot.request_table",
        "a robot's requests in layers",
    ),
    "sidecar/core/path/congestion/rtt.py": ("plr.sidecar.core.path.pmtu", "congestion control knows no path"),
    "sidecar/core/path/probing.py": ("plr.sidecar.core.transfer.routes", "links know nothing of requests"),
    "sidecar/core/rules/budget.py": ("plr.sidecar.core.path.path", "requests know nothing of links"),
    "controlplane/core/registry/registry.py": (
        "plr.controlplane.core.solve.batch",
        "the control plane's core in layers",
    ),
    "sidecar/net/watchdog.py": (
        "plr.sidecar.stop_request",
        "the network threads import the core, and little else of the sidecar",
    ),
    "sidecar/ros/stats.py": ("plr.sidecar.stop_request", "the ROS bridge imports the core and its ports"),
    "sidecar/local/answers.py": (
        "plr.sidecar.stop_request",
        "the local socket imports the core, and for types the parts that it reports",
    ),
    "controlplane/planning/fifo.py": (
        "plr.controlplane.turns",
        "planning and the CA are tools beside the control plane",
    ),
    "lab/host.py": ("plr.sidecar.stop_request", "the lab starts the programs, and imports little of them"),
    "lab/plan.py": ("bench.null_cipher", "measurements above the lab, the lab above programs and examples"),
}
"""A file, a module that it must not import, and the contract that says so."""


def test_an_upward_import_breaks_the_contract_that_forbids_it(tmp_path: Path) -> None:
    for top in (*TOPS, "examples"):
        shutil.copytree(ROOT / top, tmp_path / top, ignore=shutil.ignore_patterns("__pycache__", "results"))
    shutil.copytree(ROOT / "plr", tmp_path / "plr", symlinks=True)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for file, (module, _) in PLANTED.items():
        with (tmp_path / file).open("a") as source:
            source.write(f"\nimport {module}\n")
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    report = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert report.returncode == 1, report.stderr
    broken = set(re.findall(r"^(.+) BROKEN", report.stdout, re.MULTILINE))
    assert broken == {contract for _, contract in PLANTED.values()}
    text = " ".join(report.stdout.split())  # The report wraps long lines.
    for file, (module, _) in PLANTED.items():
        assert f"{file.removesuffix('.py').replace('/', '.')} -> {module} " in text


FOR_TYPES_ONLY = {
    "sidecar/net/interface_manager.py": r"plr\.sidecar\.config\b",
    "sidecar/local/state.py": r"plr\.sidecar\.(config|control|net|ros)\b",
}
"""A file, and what a contract lets it import for annotations; the linter cannot tell these from other imports."""


@pytest.mark.parametrize("file", FOR_TYPES_ONLY)
def test_what_a_file_may_import_for_types_it_imports_for_types(file: str) -> None:
    statements = ast.parse((ROOT / file).read_text(encoding="utf-8")).body
    at_run_time = [part for part in statements if not ast.unparse(part).startswith("if TYPE_CHECKING:")]
    assert len(at_run_time) == len(statements) - 1
    assert not re.search(rf"(from|import) {FOR_TYPES_ONLY[file]}", "\n".join(map(ast.unparse, at_run_time)))


def sources() -> list[Path]:
    """The modules that unit tests may be about, relative to the root."""
    found = (path.relative_to(ROOT) for top in TOPS for path in (ROOT / top).rglob("*.py"))
    return [path for path in found if "plr" not in path.parts]


def subject(test: Path, modules: set[Path]) -> Path | None:
    """The module, or the package, that a test file is named after: `test_MODULE.py` or `test_MODULE_ASPECT.py`."""
    folder, name = test.relative_to(UNIT).parent, test.stem.removeprefix("test_")
    words = name.split("_")
    for count in range(len(words), 0, -1):
        stem = "_".join(words[:count])
        for candidate in (folder / f"{stem}.py", folder / f"__{stem}__.py"):
            if candidate in modules:
                return candidate
    return folder if name == folder.name else None


def unit_tests() -> list[Path]:
    return sorted(path for top in TOPS for path in (UNIT / top).rglob("test_*.py"))


@pytest.mark.parametrize("test", unit_tests(), ids=lambda path: str(path.relative_to(UNIT)))
def test_a_unit_test_lies_where_its_source_does(test: Path) -> None:
    assert subject(test, set(sources())), "name it test_MODULE.py or test_MODULE_ASPECT.py, in the folder of MODULE"


def test_no_further_module_of_a_core_is_without_a_test_of_its_own() -> None:
    modules = set(sources())
    cores = {path for path in modules if path.parts[1] == "core" and path.stem != "__init__"}
    without = {str(path) for path in cores} - {str(subject(test, modules)) for test in unit_tests()}
    assert without == set(NO_TEST_OF_THEIR_OWN), "this list may only get shorter"


NO_TEST_OF_THEIR_OWN = """
controlplane/core/base/member_table.py
controlplane/core/control/events.py
controlplane/core/estimate/composed.py
controlplane/core/estimate/late_fate.py
controlplane/core/estimate/network.py
controlplane/core/estimate/penalties.py
controlplane/core/estimate/processing.py
controlplane/core/explain/alternatives.py
controlplane/core/explain/departed_explanation.py
controlplane/core/explain/fleet_view.py
controlplane/core/explain/status.py
controlplane/core/formulation/surplus.py
controlplane/core/overload/postponed.py
controlplane/core/policy/cut_off.py
controlplane/core/policy/explain.py
controlplane/core/policy/path_rules.py
controlplane/core/policy/refused_offers.py
controlplane/core/policy/report_filter.py
controlplane/core/problem/domains.py
controlplane/core/publish/messages.py
controlplane/core/publish/publisher.py
controlplane/core/registry/restlessness.py
controlplane/core/solve/batch.py
controlplane/core/solve/batch_costs.py
controlplane/core/solve/enumeration.py
controlplane/core/solve/incumbent.py
controlplane/core/solve/path_bound.py
controlplane/core/solve/server_groups.py
sidecar/core/base/report_scope.py
sidecar/core/base/values.py
sidecar/core/engine/revocation_exchange.py
sidecar/core/engine/role.py
sidecar/core/link/liveness.py
sidecar/core/link/path_table.py
sidecar/core/link/receiver.py
sidecar/core/link/sender.py
sidecar/core/message/partial.py
sidecar/core/path/address.py
sidecar/core/path/congestion/bandwidth_search.py
sidecar/core/path/congestion/units.py
sidecar/core/path/in_flight.py
sidecar/core/path/key_exchange.py
sidecar/core/path/view.py
sidecar/core/robot/dispatch/context.py
sidecar/core/robot/fallback/queue.py
sidecar/core/robot/request/index.py
sidecar/core/robot/request/request.py
sidecar/core/rules/budget.py
sidecar/core/seam/application.py
sidecar/core/seam/links.py
sidecar/core/seam/stats.py
sidecar/core/stun/events.py
sidecar/core/stun/family.py
sidecar/core/stun/transaction.py
sidecar/core/transfer/engine_parts.py
sidecar/core/transfer/inbound.py
sidecar/core/transfer/room.py
""".split()
"""Tested through the modules that use them, and in tests/sim."""
