"""Lists which counters of the honest programs show each attack (docs/operate/metrics.md)."""

from __future__ import annotations

INTERESTING = (
    "datagrams_dropped",
    "messages_dropped",
    "bad_answers",
    "refused_connections",
    "registrations_refused",
    "streams_ended",
    "control_dropped",
    "offers_refused",
    "stun_datagrams",
    "executions",
    "nacks",
    "bridge_dropped",
    "bridge_unanswered",
    "departures",
)
"""Prefixes of the counters of refusals, without `plr_` and `_total`."""

COUNTED: dict[str, tuple[str, ...]] = {
    "256 addresses of a third party": ("messages_dropped bad_candidates", "messages_dropped old_candidates"),
    "answers that are CDR bombs": ("bad_answers",),
    "answers that nobody asked for": ("messages_dropped answer_to_unknown_request",),
    "blind acknowledgements": ("datagrams_dropped acks_the_unsent",),
    "cancels": ("executions cancelled",),
    "escape sequences in refusals": ("control_dropped stale_answer",),
    "false reports": ("control_dropped report_forbidden", "control_dropped report_of_cloud"),
    "forged restarts": ("messages_dropped bad_credential", "messages_dropped verifications_full"),
    "fuzzed datagrams, rightly sealed": (
        "datagrams_dropped malformed",
        "datagrams_dropped unasked_probe_reply",
        "messages_dropped reassembly_evicted",
    ),
    "fuzzed streams": ("streams_ended invalid_argument",),
    "garbage in place of answers": ("bad_answers",),
    "handshakes begun and left": ("refused_connections",),
    "offers of keys with wrong proofs": ("datagrams_dropped bad_keys",),
    "wrong answers to offers of keys": ("datagrams_dropped bad_keys",),
    "phantom interfaces": ("datagrams_dropped new_paths_too_often", "datagrams_dropped paths_full"),
    "registrations under another's name": ("registrations_refused name_mismatch",),
    "registrations of a session of before": (
        "registrations_refused name_taken",
        "registrations_refused older_incarnation",
    ),
    "registrations with another session number": ("registrations_refused bad_credential",),
    "replayed introductions": ("datagrams_dropped duplicate",),
    "introductions replayed from a third party": ("datagrams_dropped duplicate",),
    "requests from a third party's address": ("datagrams_dropped address_unproven",),
    "requests that are CDR bombs": ("executions refused",),
    "sessions begun, 31 interfaces each": ("datagrams_dropped old_introduction",),
    "services that are not its own, with escape sequences": ("streams_ended invalid_argument",),
    "silent connections": ("refused_connections",),
    "small requests": ("executions run",),
    "STUN questions": ("stun_datagrams too_often",),
}
