"""The documentation says what the programs do: metrics, log lines, certificates, links."""

from __future__ import annotations

import ast
import functools
import re
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import key_file, passphrase
from plr.controlplane.ca.authority import DEFAULT_DAYS
from plr.controlplane.ca.request import MAX_CERTIFICATE_REQUEST_BYTES
from plr.controlplane.core.control.control import ControlCore
from plr.controlplane.observe.fleet_metrics import Fleet
from plr.controlplane.observe.metrics import Metrics
from plr.protos.base.histogram import Histogram
from plr.protos.convert.fields import MAX_CRL_BYTES
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.program.tls_files import MAX_TLS_FILE_BYTES
from plr.protos.trust.identity import MAX_CA_CERTIFICATES, Identity, IdentityRole, RevocationList
from plr.sidecar.control.client import JUDGE_AGAIN_S
from plr.sidecar.control.revocations import RevocationState
from plr.sidecar.core.control.session import ControlStats
from plr.sidecar.core.engine.revocation_exchange import ASK_AGAIN_S, ASK_NEXT_AFTER_S
from plr.sidecar.core.seam.stats import EngineStats, LinkStats
from plr.sidecar.core.wire.messages import RevocationsHeld, encode_message
from plr.sidecar.observe.metrics import MetricSources, SidecarCollector
from plr.sidecar.ros.stats import BridgeStats

if TYPE_CHECKING:
    from collections.abc import Iterator

    from prometheus_client import Metric

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LISTS = {1: RevocationList(3, 0.0, 1.0, b"")}
PAGES = sorted(
    path
    for pattern in ("*.md", "lab/*.md", "docs/**/*.md", "deploy/**/*.md", "examples/**/*.md")
    for path in ROOT.glob(pattern)
)


def read(page: str) -> str:
    (path,) = DOCS.glob(f"*/{page}")
    return path.read_text(encoding="utf-8")


def section(text: str, heading: str) -> str:
    """What stands under a second-level heading."""
    return text.split(f"\n## {heading}\n", 1)[1].split("\n## ", 1)[0]


def rows(text: str) -> Iterator[list[str]]:
    """Yield the cells of every table row."""
    for line in text.splitlines():
        if line.startswith("| ") and not line.startswith("| ---"):
            yield [cell.strip() for cell in line.strip("|").split(" | ")]


# -- metrics ------------------------------------------------------------------------------------------------------


def _sidecar_metrics() -> Iterator[Metric]:
    engine = EngineStats(durations={ServiceName("/s"): Histogram()})
    sources = MetricSources(
        name="robot",
        role="robot",
        version="0",
        engine=lambda: engine,
        links=lambda: [LinkStats(InterfaceName("wlan0"), paths={})],
        unmet=lambda: ["/plan"],
        interfaces=lambda: {InterfaceName("wlan0"): True},
        control=ControlStats,
        connected=lambda: True,
        bridge=lambda: BridgeStats(unanswered=Counter({(ServiceName("/s"), "failed"): 1})),
        state_failures=dict,
        certificate=lambda: Identity(NodeName("robot"), IdentityRole.ROBOT, 1, 0.0, 1.0),
        files_refused=lambda: False,
        revocations=lambda: RevocationState(LISTS, frozenset(), 86_400.0),
        local_refused=lambda: {},
    )
    yield from SidecarCollector(sources).collect()


def _control_metrics() -> Iterator[Metric]:
    from plr.controlplane.core.control.events import Settings

    metrics = Metrics()
    metrics.watch_fleet(lambda: Fleet((), (), {}, 0.0, 0.0))
    metrics.own_certificate(Identity(NodeName("control"), IdentityRole.CONTROL_PLANE, 1, 0.0, 1.0), LISTS)
    metrics.update(ControlCore(Settings(), version_epoch=1, now=0.0), (), 0)
    yield from metrics.registry.collect()


def exported_names(metrics: Iterator[Metric]) -> set[str]:
    suffix = {"counter": "_total", "info": "_info"}
    return {metric.name + suffix.get(metric.type, "") for metric in metrics}


def exported() -> set[str]:
    return exported_names(_sidecar_metrics()) | exported_names(_control_metrics())


def test_every_metric_is_documented() -> None:
    in_tables = {cells[0].strip("`") for cells in rows(read("metrics.md")) if cells[0].startswith("`plr_")}
    processes = {name for name in exported() if name.startswith("process_")}  # the client library's
    assert in_tables == exported() - processes


def test_no_page_names_a_metric_that_does_not_exist() -> None:
    known = exported() | {name + end for name in exported() for end in ("_bucket", "_sum", "_count")}
    for page in PAGES:
        for name in re.findall(r"\bplr_[a-z_]+_(?:total|seconds|bucket|version|info|up|ratio)\b", page.read_text()):
            assert name in known, f"{page}: {name}"


def test_every_alert_is_named() -> None:
    rules = (ROOT / "deploy/prometheus/plr-rules.yml").read_text()
    alerts = re.findall(r"- alert: (\w+)", rules)
    assert alerts
    assert [name for name in alerts if f"`{name}`" not in section(read("metrics.md"), "Alerts")] == []


# -- log lines ----------------------------------------------------------------------------------------------------


@functools.cache
def _program_texts() -> tuple[str, ...]:
    """All string constants of the programs; an f-string gives one for each of its parts."""
    return tuple(
        node.value
        for package in ("sidecar", "controlplane", "protos")
        for path in (ROOT / package).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


@functools.cache
def _whole_texts() -> frozenset[str]:
    return frozenset(text.strip(PUNCTUATION) for text in _program_texts())


PUNCTUATION = " :;,()"


def is_written(text: str) -> bool:
    """Whether constants hold the text: as a whole, or in pieces of several words or whole constants."""
    words = text.split()
    while words:
        for count in range(len(words), 0, -1):
            piece = " ".join(words[:count]).strip(PUNCTUATION)
            if piece in _whole_texts() or (count > 1 and any(piece in known for known in _program_texts())):
                break
        else:
            return False
        del words[:count]
    return True


def log_lines() -> list[str]:
    """The lines that troubleshooting.md quotes: the first column of its tables with the heading "log line"."""
    found = []
    inside = False
    for line in read("troubleshooting.md").splitlines():
        if line.startswith("| log line"):
            inside = True
        elif not line.startswith("|"):
            inside = False
        elif inside and not line.startswith("| ---"):
            cell = line.split(" | ")[0].removeprefix("| ")
            if cell.startswith("`"):
                found.append(cell.strip("`"))
    return found


@pytest.mark.parametrize("line", log_lines())
def test_the_programs_write_the_quoted_line(line: str) -> None:
    fragments = [fragment for fragment in line.split("…") if len(fragment.strip(PUNCTUATION)) > 2]
    assert fragments
    assert [fragment for fragment in fragments if not is_written(fragment)] == []


def test_a_line_that_nobody_writes_is_noticed() -> None:
    assert not is_written("control plane quietly eaten by wolves")


# -- certificates -----------------------------------------------------------------------------------------------


def test_the_page_of_certificates_has_the_numbers_of_the_code() -> None:
    page = " ".join(read("certificates.md").split())
    for said in (
        f"a passphrase of {passphrase.MIN_PASSPHRASE_BYTES} to {passphrase.MAX_PASSPHRASE_BYTES} bytes",
        f"N = 2^{key_file.SCRYPT_N.bit_length() - 1}, r = {key_file.SCRYPT_R}, p = {key_file.SCRYPT_P}",
        f"a certificate for {DEFAULT_DAYS:.0f} days",
        f"the CAs to believe, {MAX_CA_CERTIFICATES} at most",
        f"a file of more than {MAX_TLS_FILE_BYTES >> 20} MiB",
        f"one of more than {MAX_CERTIFICATE_REQUEST_BYTES >> 10} KiB",
        f"Lists of more than {MAX_CRL_BYTES >> 20} MiB in all",
        f"its number, {encode_message(RevocationsHeld({1: 1})).size} bytes for one CA",
        f"one question in {ASK_NEXT_AFTER_S:.0f} s at most",
        f"is asked after {ASK_AGAIN_S:.0f} s, {2 * ASK_AGAIN_S:.0f} s",
        f"It judges them again every {JUDGE_AGAIN_S:.0f} s",
    ):
        assert said in page, said


# -- links --------------------------------------------------------------------------------------------------------


def anchor(heading: str) -> str:
    """The anchor that forges make of a heading."""
    text = re.sub(r"[`*]", "", heading).strip().lower()
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


def links() -> Iterator[tuple[Path, str]]:
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            if "://" not in target:
                yield page, target


def test_internal_links_resolve() -> None:
    broken = []
    for page, target in links():
        path, _, fragment = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists():
            broken.append(f"{page.relative_to(ROOT)}: {target}")
        elif fragment:
            headings = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
            if fragment not in {anchor(heading) for heading in headings}:
                broken.append(f"{page.relative_to(ROOT)}: {target}")
    assert broken == []


def test_every_page_is_linked_from_the_readme() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [page.name for page in DOCS.glob("*/*.md") if f"(docs/{page.parent.name}/{page.name})" not in readme] == []


def test_architecture_names_files_that_exist() -> None:
    named = re.findall(
        r"`((?:sidecar|controlplane|protos|lab|bench|tests|deploy|examples)/[\w./-]+)`", read("architecture.md")
    )
    assert len(named) > 20
    assert [name for name in named if not (ROOT / name).exists()] == []
    bare = set(re.findall(r"[`>\s]([a-z_-]+\.(?:py|yml))\b", read("architecture.md")))
    known = {
        path.name
        for folder in ("sidecar", "controlplane", "protos", "lab", "bench", "tests", "deploy")
        for path in (ROOT / folder).rglob("*.*")
    }
    assert bare - known == set()


def test_architecture_names_every_thread_and_every_lock_of_the_programs() -> None:
    found = section(read("architecture.md"), "Threads, loops and locks")
    locks = found.split("### Locks", 1)[1]
    missing = []
    for path in (path for package in ("sidecar", "controlplane", "protos") for path in (ROOT / package).rglob("*.py")):
        text, name = path.read_text(encoding="utf-8"), str(path.relative_to(ROOT))
        if re.search(r"threading\.Thread\(|ThreadPoolExecutor\(|asyncio\.to_thread\(", text) and name not in found:
            missing.append(f"thread of {name}")
        missing += [f"thread {one}" for one in re.findall(r"name=\"(plr-[\w-]+)\"", text) if f"`{one}`" not in found]
        if re.search(r"(threading|asyncio)\.(R?Lock|Condition|(Bounded)?Semaphore)\(", text) and name not in locks:
            missing.append(f"lock of {name}")
    assert missing == []


def test_sources_name_pages_that_exist() -> None:
    sources = [
        path
        for folder in ("sidecar", "controlplane", "protos", "lab", "bench", "deploy")
        for path in (ROOT / folder).rglob("*")
    ]
    broken = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources
        if path.suffix in {".py", ".sh", ".yaml", ".yml", ".service", ".proto"}
        for name in re.findall(r"docs/[\w./-]+\.md", path.read_text(encoding="utf-8"))
        if not (ROOT / name).exists()
    ]
    assert broken == []
