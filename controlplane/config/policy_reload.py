"""Reloads the access policy from the configuration file while running, on SIGHUP.

It does not react to changes of the file: a half-saved file must not decide who may do what. If the file cannot be read
or is invalid, the policy in force stays.
"""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING

from plr.controlplane.config.controlplane import load_config
from plr.protos.base.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from pathlib import Path

    from plr.controlplane.config.controlplane import ControlPlaneConfig
    from plr.controlplane.core.policy.policy import Policy
    from plr.controlplane.observe.metrics import Metrics

log = logging.getLogger(__name__)


def doubt(policy: Policy | None) -> str | None:
    """Return a warning about a policy, or about having none; None if there is nothing to warn of."""
    if policy is None:
        return "there is no policy: every robot may call, and every cloud may offer, every service"
    if policy.calls and policy.offers:
        return None
    nobody = "no robot may call any service" if not policy.calls else "no cloud may offer any service"
    return f"policy: rules for calls {len(policy.calls)}, for offers {len(policy.offers)}: {nobody}"


def announce(policy: Policy | None) -> None:
    """Log the policy in force."""
    problem = doubt(policy)
    if problem is not None:
        log.warning("%s", problem)
    elif policy is not None:
        log.info("policy in force: rules for calls %d, for offers %d", len(policy.calls), len(policy.offers))


class PolicyReload:
    """Reads the file again for each `request`."""

    def __init__(self, source: Path, config: ControlPlaneConfig) -> None:
        self._source = source
        self._config = config
        self._requested = asyncio.Event()

    def request(self) -> None:
        """Read the file soon; for a signal handler."""
        self._requested.set()

    async def run(self, apply: Callable[[Policy | None], Awaitable[None]], metrics: Metrics) -> None:
        """Serve requests until cancelled; `apply` puts a policy into force."""
        announce(self._config.settings().policy)
        while True:
            await self._requested.wait()
            self._requested.clear()
            try:
                config = await asyncio.to_thread(load_config, self._source)
            except ConfigError as error:
                metrics.policy_reloads.labels("refused").inc()
                log.error("%s; the policy in force stays", error)
                continue
            await self._take(config, apply)
            metrics.policy_reloads.labels("applied").inc()

    async def _take(self, config: ControlPlaneConfig, apply: Callable[[Policy | None], Awaitable[None]]) -> None:
        changed = [key for key in type(config).model_fields if getattr(config, key) != getattr(self._config, key)]
        others = [key for key in changed if key != "policy"]
        if others:
            log.warning("%s: %s changed too, which needs a restart", self._source, ", ".join(others))
        if "policy" not in changed:
            log.info("%s: the policy is the same as before", self._source)
            return
        self._config = self._config.model_copy(update={"policy": config.policy})
        policy = self._config.settings().policy
        announce(policy)
        await apply(policy)
