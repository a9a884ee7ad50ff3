"""The CA of a fleet: issues the certificates that name every node, and revokes them."""

from controlplane.ca.authority import Authority, AuthorityError
from controlplane.ca.certificates import Issued, Validity
from controlplane.ca.index import Entry

__all__ = ["Authority", "AuthorityError", "Entry", "Issued", "Validity"]
