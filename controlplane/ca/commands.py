"""Defines `plr ca`, the fleet's CA on the command line, and `plr request`, a node's request to it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cryptography.x509 import ReasonFlags

from plr.controlplane.ca import actions, request_actions
from plr.controlplane.ca.authority import DEFAULT_CA_DAYS, DEFAULT_DAYS, AuthorityError
from plr.controlplane.ca.passphrase import NEW_VARIABLE, VARIABLE
from plr.protos.base.errors import ConfigError, DecodeError
from plr.protos.base.printable import escaped
from plr.protos.model.names import node_name, text
from plr.protos.program import endings
from plr.protos.program.arguments import checked
from plr.protos.program.exit_codes import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.program.arguments import Commands


_EXAMPLES = """examples:
  plr ca init --name warehouse
  plr ca issue cp --role controlplane
  plr ca issue robot-1 --role robot --days 30
  plr ca issue alice --role operator --out ~/.plr-tls
  plr ca sign request.pem --name robot-2 --role robot
  plr ca list
  plr ca renew robot-1
  plr ca revoke robot-1 --reason keyCompromise
  plr ca passphrase

exit codes: 0 ok, 1 refused or not done, 2 bad usage or a CA folder that is not in order
"""

_REQUEST_EXAMPLES = """examples:
  plr request robot-7 --role robot
  plr request robot-7 --role robot --out /etc/plr/tls --keep-key
  plr request alice --role operator --out ~/.plr-tls

exit codes: 0 ok, 1 refused or not done, 2 bad usage or a key that is not in order
"""

_REASONS = [
    reason.value
    for reason in (
        ReasonFlags.unspecified,
        ReasonFlags.key_compromise,
        ReasonFlags.superseded,
        ReasonFlags.cessation_of_operation,
        ReasonFlags.privilege_withdrawn,
    )
]
_ROLES = [role.value for role in IdentityRole]
_MAX_DAYS = 36_500.0
_MAX_COMMON_NAME = 64


def add_ca(commands: Commands, summary: str) -> None:
    """Add `plr ca`."""
    ca = commands.add_parser(
        "ca",
        help=summary,
        description="Issue, renew and revoke the certificates that name every node of the fleet.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    about = ca.add_subparsers(required=True, metavar="COMMAND")
    for name, command, about_it, details in (
        ("init", actions.init, "make the CA", "Make the CA's key and certificate in a folder of its own."),
        ("issue", actions.issue, "make a node's key and certificate", "Write a folder ready to be the node's tls_dir."),
        (
            "sign",
            request_actions.sign,
            "certify a key that stays on its node",
            "Show what a file of plr request asks for, and sign it once you confirm the name and the role, with both "
            "options or at the terminal. Only the key is taken from the file itself.",
        ),
        (
            "renew",
            actions.renew,
            "make a further certificate for a node",
            "The previous certificate stays valid until it expires.",
        ),
        ("revoke", actions.revoke, "refuse a node from now on", "Revoke all certificates of a name and write crl.pem."),
        (
            "publish",
            actions.publish,
            "sign the revocation list again",
            "Sign the same list with the current time, for nodes that demand a recent one (max_revocation_age_s).",
        ),
        ("list", actions.show, "show what was issued", "Show every certificate and how long it is valid."),
        ("rotate", actions.rotate, "make a new CA next to the one in use", "Nodes trust both until: plr ca retire."),
        ("retire", actions.retire, "stop trusting former CAs", "It is refused while a node depends on one of them."),
        (
            "passphrase",
            actions.change_passphrase,
            "change the passphrase of the CA's key",
            "Encrypt the key again, or for the first time. No certificate changes.",
        ),
    ):
        parser = about.add_parser(name, help=about_it, description=details)
        parser.add_argument("--dir", type=Path, default=Path("plr-ca"), help="the CA's folder (default: ./plr-ca)")
        _ARGUMENTS[name](parser)
        parser.set_defaults(run=_reported(command, lambda arguments: arguments.dir))


def add_request(commands: Commands, summary: str) -> None:
    """Add `plr request`."""
    parser = commands.add_parser(
        "request",
        help=summary,
        description="Make a key and a request for its certificate, for plr ca sign. The key stays on this machine.",
        epilog=_REQUEST_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", type=checked(node_name), metavar="NAME")
    parser.add_argument("--role", required=True, choices=_ROLES)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        default=Path("plr-request"),
        help="where to write it (default: ./plr-request)",
    )
    parser.add_argument("--keep-key", action="store_true", help="ask for a certificate of the existing key")
    parser.set_defaults(run=_reported(request_actions.request, lambda arguments: arguments.out))


def _signing(parser: argparse.ArgumentParser) -> None:
    help_text = f"passphrase of the CA's key (default: {VARIABLE} of the environment; without it, you are asked)"
    parser.add_argument("--passphrase-file", type=Path, metavar="FILE", help=help_text)


def _authority_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--name", type=_common_name, default="fleet", help="name of the CA (default: fleet)")
    parser.add_argument("--days", type=_days, default=DEFAULT_CA_DAYS, help="days until it expires (default: 3650)")


def _init_arguments(parser: argparse.ArgumentParser) -> None:
    _authority_arguments(parser)
    choice = parser.add_mutually_exclusive_group()
    help_text = f"passphrase for the CA's key (default: {VARIABLE} of the environment; without it, you are asked)"
    choice.add_argument("--passphrase-file", type=Path, metavar="FILE", help=help_text)
    _no_passphrase(choice)


def _rotate_arguments(parser: argparse.ArgumentParser) -> None:
    _authority_arguments(parser)
    _signing(parser)


def _passphrase_arguments(parser: argparse.ArgumentParser) -> None:
    _signing(parser)
    choice = parser.add_mutually_exclusive_group()
    help_text = f"new passphrase for the key (default: {NEW_VARIABLE} of the environment; without it, you are asked)"
    choice.add_argument("--new-passphrase-file", type=Path, metavar="FILE", help=help_text)
    _no_passphrase(choice)


def _no_passphrase(choice: argparse._MutuallyExclusiveGroup) -> None:
    help_text = "leave the CA's key unencrypted: whoever reads the file can pose as any node"
    choice.add_argument("--no-passphrase", action="store_true", help=help_text)


def _out_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", type=checked(node_name), metavar="NAME")
    _certificate_arguments(parser)


def _certificate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--days", type=_days, default=DEFAULT_DAYS, help="days until it expires (default: 90)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to write it (default: nodes/NAME in --dir)")
    _signing(parser)


def _issue_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--role", required=True, choices=_ROLES)
    _out_arguments(parser)


def _sign_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("request", type=Path, metavar="REQUEST", help="the request.pem that plr request wrote")
    parser.add_argument("--name", type=checked(node_name), help="the name that it must ask for")
    parser.add_argument("--role", choices=_ROLES, help="the role that it must ask for")
    parser.add_argument(
        "--fingerprint", metavar="SHA256:...", help="the fingerprint that its key must have, as plr request shows it"
    )
    parser.add_argument(
        "--renew", action="store_true", help="the name already has a certificate, which stays valid until it expires"
    )
    _certificate_arguments(parser)


def _renew_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--keep-key", action="store_true", help="certify the existing key instead of making a new one")
    _out_arguments(parser)


def _revoke_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", type=checked(node_name), metavar="NAME")
    parser.add_argument("--reason", choices=_REASONS, default=ReasonFlags.unspecified.value)
    _signing(parser)


_ARGUMENTS: dict[str, Callable[[argparse.ArgumentParser], None]] = {
    "init": _init_arguments,
    "issue": _issue_arguments,
    "sign": _sign_arguments,
    "renew": _renew_arguments,
    "revoke": _revoke_arguments,
    "publish": _signing,
    "list": lambda parser: None,
    "rotate": _rotate_arguments,
    "retire": _signing,
    "passphrase": _passphrase_arguments,
}


def _reported(
    command: Callable[[argparse.Namespace], str], folder: Callable[[argparse.Namespace], Path]
) -> Callable[[argparse.Namespace], int]:
    def run(arguments: argparse.Namespace) -> int:
        try:
            text = command(arguments)
        except AuthorityError as error:
            _complain(str(error))
            return EXIT_FAILED
        except ConfigError as error:
            _complain(str(error))
            return EXIT_USAGE
        except KeyboardInterrupt:
            sys.stderr.write("\nplr: stopped\n")
            return EXIT_FAILED
        except OSError as error:
            _complain(f"{error.filename or folder(arguments)}: {error.strerror or error}")
            return EXIT_FAILED
        shown = "\n".join(map(escaped, text.split("\n")))
        if command is actions.show:
            sys.stdout.write(f"{shown}\n")
        else:
            _tell_of_what_is_done(shown)
        return EXIT_OK

    return run


def _tell_of_what_is_done(shown: str) -> None:
    """Print the outcome, and never fail: a script that took that for a refusal would retry and find the name taken."""
    if sys.stdout is None:
        return
    try:
        sys.stdout.write(f"{shown}\n")
        sys.stdout.flush()
    except OSError as error:
        endings.print_no_more()
        sys.stderr.write(f"plr: done, but it cannot be printed ({error.strerror}): {shown.partition(chr(10))[0]}\n")


def _complain(problem: str) -> None:
    # The problem may contain a file name chosen by somebody else.
    sys.stderr.write(f"plr: {escaped(problem)}\n")


def _common_name(value: str) -> str:
    try:
        text(value, "the name")
    except DecodeError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    if not 1 <= len(value.encode()) <= _MAX_COMMON_NAME:
        raise argparse.ArgumentTypeError(f"expected 1 to {_MAX_COMMON_NAME} bytes (UTF-8)")
    return value


def _days(value: str) -> float:
    try:
        days = float(value)
    except ValueError:
        days = 0.0
    if not 0 < days <= _MAX_DAYS:
        raise argparse.ArgumentTypeError(f"expected a number of days, more than 0, at most {_MAX_DAYS:.0f}")
    return days
