"""Random policies over a small world, so that rules often match and often do not."""

from __future__ import annotations

from hypothesis import strategies as st

from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy

ROBOTS = ("robot", "robot-2", "arm-1")
CLOUDS = ("a", "b", "cloud-c")
SERVICES = ("/plan", "/detect", "/arm/grip")

_robots = st.lists(st.sampled_from((*ROBOTS, "*", "robot*", "arm-?")), min_size=1, max_size=2).map(tuple)
_clouds = st.lists(st.sampled_from((*CLOUDS, "*", "[ab]")), min_size=1, max_size=2).map(tuple)
_services = st.lists(st.sampled_from((*SERVICES, "*", "/arm/*")), min_size=1, max_size=2).map(tuple)

policies = st.builds(
    Policy,
    st.lists(st.builds(CallRule, _robots, _services, _clouds), max_size=4).map(tuple),
    st.lists(st.builds(OfferRule, _clouds, _services), max_size=4).map(tuple),
)
