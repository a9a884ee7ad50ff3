"""The CA of a fleet: issues the certificates that name every node, and revokes them."""

from plr.controlplane.ca.authority import Authority, AuthorityError
from plr.controlplane.ca.certificates import Issued, Validity
from plr.controlplane.ca.index import Entry

__all__ = ["Authority", "AuthorityError", "Entry", "Issued", "Validity"]
