"""Converts between protobuf and model in both directions, and validates.

`*_to_proto` encodes a model value. `*_from_proto` checks every field of a message from the network and returns a model
value, or raises `DecodeError` and nothing else; `parse_*` does the same from bytes. A value survives encoding and
decoding unchanged, except for what the format rounds: times to microseconds, texts for people to `MAX_STRING_BYTES`
printable bytes.
"""

from __future__ import annotations

from plr.protos.convert.admin import (
    own_revocations_from_proto,
    status_from_proto,
    status_query_from_proto,
    status_query_to_proto,
    status_to_proto,
)
from plr.protos.convert.control import (
    control_message_from_proto,
    control_message_to_proto,
    parse_control_message,
    parse_in_parts,
    parse_sidecar_message,
    read_sidecar_message,
    sidecar_message_from_proto,
    sidecar_message_to_proto,
)
from plr.protos.convert.events import (
    departed_from_proto,
    departed_to_proto,
    event_list_from_proto,
    event_query_from_proto,
    event_query_to_proto,
    event_to_proto,
    events_from_proto,
    log_state_from_proto,
    log_state_to_proto,
)
from plr.protos.convert.explanation import (
    explain_request_from_proto,
    explanation_from_proto,
    explanation_to_proto,
    pairs_to_proto,
)
from plr.protos.convert.mapping import mapping_set_from_proto, mapping_set_to_proto
from plr.protos.convert.reports import report_from_proto, report_to_proto
from plr.protos.convert.types import (
    address_from_proto,
    address_to_proto,
    candidate_from_proto,
    candidate_to_proto,
    histogram_from_proto,
    histogram_to_proto,
    offer_from_proto,
    offer_to_proto,
    peer_from_proto,
    peer_to_proto,
    use_from_proto,
    use_to_proto,
)

__all__ = [
    "address_from_proto",
    "address_to_proto",
    "candidate_from_proto",
    "candidate_to_proto",
    "control_message_from_proto",
    "control_message_to_proto",
    "departed_from_proto",
    "departed_to_proto",
    "event_list_from_proto",
    "event_query_from_proto",
    "event_query_to_proto",
    "event_to_proto",
    "events_from_proto",
    "explain_request_from_proto",
    "explanation_from_proto",
    "explanation_to_proto",
    "histogram_from_proto",
    "histogram_to_proto",
    "log_state_from_proto",
    "log_state_to_proto",
    "mapping_set_from_proto",
    "mapping_set_to_proto",
    "offer_from_proto",
    "offer_to_proto",
    "own_revocations_from_proto",
    "pairs_to_proto",
    "parse_control_message",
    "parse_in_parts",
    "parse_sidecar_message",
    "peer_from_proto",
    "peer_to_proto",
    "read_sidecar_message",
    "report_from_proto",
    "report_to_proto",
    "sidecar_message_from_proto",
    "sidecar_message_to_proto",
    "status_from_proto",
    "status_query_from_proto",
    "status_query_to_proto",
    "status_to_proto",
    "use_from_proto",
    "use_to_proto",
]
