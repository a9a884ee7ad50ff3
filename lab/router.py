"""Configures the NAT router: its nftables rules, and forgetting its mappings."""

from __future__ import annotations

import os
import socket
import struct
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lab.topology import NatSpec

# Source ports of the n-th rebinding: disjoint from those of the rebindings before and after it, and
# above Linux's ephemeral ports (32768..60999), since a port already in the range would be kept.
_REBIND_FIRST_PORT = 61_000
_REBIND_PORTS = 500
_REBIND_RANGES = 9
# linux/netlink.h, linux/netfilter/nfnetlink.h, nfnetlink_conntrack.h
_NETLINK_NETFILTER = 12
_CTNETLINK_DELETE = (1 << 8) | 2
_NLM_F_REQUEST_ACK = 5

_FILTER_RULES = """
table inet firewall {
  chain input {
    type filter hook input priority filter; policy drop;
    ct state established,related accept
    iifname { "lo", "lan0" } accept
    icmpv6 type { nd-neighbor-solicit, nd-neighbor-advert, nd-router-solicit, nd-router-advert } accept
  }
  chain forward {
    type filter hook forward priority filter; policy drop;
    ct state established,related accept
    iifname "lan0" oifname "wan0" accept
  }
}
"""


def router_sysctls(nat: NatSpec) -> dict[str, str]:
    """Return the kernel settings of this router besides forwarding."""
    if nat.udp_timeout_s is None:
        return {}
    timeout = str(nat.udp_timeout_s)
    return {
        "net/netfilter/nf_conntrack_udp_timeout": timeout,
        "net/netfilter/nf_conntrack_udp_timeout_stream": timeout,
    }


def router_rules(nat: NatSpec) -> str:
    """Return the router's whole rule set, for `nft -f -`."""
    return _FILTER_RULES + translation_rules(nat, rebindings=0)


def translation_rules(nat: NatSpec, *, rebindings: int) -> str:
    """Return the translation rules after this many rebindings; they replace those in force in one transaction."""
    how = "masquerade"
    if rebindings:
        first = _REBIND_FIRST_PORT + (rebindings - 1) % _REBIND_RANGES * _REBIND_PORTS
        how += f" to :{first}-{first + _REBIND_PORTS - 1}"
    if nat.kind == "symmetric":
        how += " fully-random"
    return f"""
table ip translation
delete table ip translation
table ip translation {{
  chain postrouting {{
    type nat hook postrouting priority srcnat;
    oifname "wan0" meta l4proto {{ tcp, udp }} {how}
    oifname "wan0" masquerade
  }}
}}
"""


def flush_connection_tracking() -> None:
    """Forget every connection, and so every mapping, of the current network namespace; raises OSError."""
    header = struct.pack("=IHHII", 20, _CTNETLINK_DELETE, _NLM_F_REQUEST_ACK, 1, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_NETFILTER) as netlink:
        netlink.send(header + struct.pack("=BBH", socket.AF_UNSPEC, 0, 0))
        (code,) = struct.unpack_from("=i", netlink.recv(4096), 16)
    if code:
        raise OSError(-code, os.strerror(-code))
