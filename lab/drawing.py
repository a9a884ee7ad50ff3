"""Draws the topology as text, with the addresses of a plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lab.plan import CORE

if TYPE_CHECKING:
    from lab.plan import Plan
    from lab.topology import LabConfig


def draw(config: LabConfig, plan: Plan) -> str:
    """Return one line per interface: host, address, link, router with its public address; then where all meet."""
    rows: list[tuple[str, str, str]] = []
    for host in config.hosts:
        for interface in host.interfaces:
            address = plan.addresses[host.name][interface.name]
            name = f"{host.name} {interface.name}"
            where = f"{address[4]} {address[6]}"
            path = "~~ emulated link ~~" if interface.emulated else "───────────────────"
            if interface.nat is not None:
                router = plan.gateways[host.name][interface.name]
                path += f"[ NAT {plan.addresses[router]['wan0'][4]} ]"
            rows.append((name, where, path))
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = []
    for position, (name, where, path) in enumerate(rows):
        end = "┐" if position == 0 else "┘" if position == len(rows) - 1 else "┤"
        label = f" {CORE}" if position == len(rows) // 2 else ""
        lines.append(f"{name:<{widths[0]}}  {where:<{widths[1]}}  {path + '─' * (widths[2] - len(path))}──{end}{label}")
    return "\n".join(lines)
