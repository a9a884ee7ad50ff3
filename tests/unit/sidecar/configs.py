"""Configurations that tests change a little."""

from __future__ import annotations

from typing import Any

import yaml

from plr.sidecar.config.sidecar import SidecarConfig, parse_config

SOURCE = "sidecar.yaml"
ROBOT: dict[str, Any] = {
    "name": "robot-1",
    "role": "robot",
    "insecure": True,
    "control_plane": "plr.example.org:50051",
    "services": [{"name": "/plan_path", "deadline_ms": 100}],
}
CLOUD: dict[str, Any] = {
    "name": "cloud-a",
    "role": "cloud",
    "insecure": True,
    "control_plane": "[2001:db8::1]:50051",
    "services": [{"name": "/*"}],
}

SAFE: dict[str, Any] = {"idempotent": True}
BACKED: dict[str, Any] = {"deadline_ms": 100, "idempotent": True, "fallback": "/b"}


def parse(base: dict[str, Any], **changes: Any) -> SidecarConfig:
    return parse_config(yaml.safe_dump({**base, **changes}), SOURCE)


def with_service(base: dict[str, Any], **keys: Any) -> dict[str, Any]:
    return {**base, "services": [{**base["services"][0], **keys}]}
