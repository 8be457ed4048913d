"""Connection strings: every spelling that users of pymavlink, MAVProxy, MAVSDK and mavlink-server know, to one address.

Pure.  `canonical` prints the one spelling that our own messages use.
"""

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from companion.errors import UserError


class Medium(StrEnum):
    """What kind of link an address names; the values are the canonical spellings."""

    UDP_LISTEN = "udpin"
    UDP_SEND = "udpout"
    UDP_BROADCAST = "udpbcast"
    TCP_CONNECT = "tcp"
    TCP_LISTEN = "tcpin"
    SERIAL = "serial"


@dataclass(frozen=True, slots=True)
class Address:
    """One link's address; host and port, or device and baud."""

    medium: Medium
    host: str = ""
    port: int = 0
    device: str = ""
    baud: int = 0
    flow_control: bool = False
    hint: str = ""  # the spelling is understood but outdated or ambiguous

    @property
    def canonical(self) -> str:
        if self.medium is Medium.SERIAL:
            return f"{'serial_flowcontrol' if self.flow_control else 'serial'}:{self.device}:{self.baud}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.medium.value}:{host}:{self.port}"


EXAMPLES: Final = "udpin:0.0.0.0:14550, udpout:127.0.0.1:14550, tcp:127.0.0.1:5760, /dev/ttyACM0,57600"
DEFAULT_BAUD: Final = 57600  # of a device on USB, where it has no effect; a UART must say its own
FASTEST_BAUD: Final = 100_000_000
USB_DEVICE: Final = re.compile(r"/dev/(ttyACM|ttyUSB|serial/by-id/|serial/by-path/|cu\.usb|pts/)")
ANY_HOST: Final = ("", "0.0.0.0", "::")

SCHEMES: Final = {
    "udp": Medium.UDP_LISTEN,  # pymavlink: listen
    "udpin": Medium.UDP_LISTEN,
    "udpserver": Medium.UDP_LISTEN,
    "udps": Medium.UDP_LISTEN,
    "udpout": Medium.UDP_SEND,
    "udpclient": Medium.UDP_SEND,
    "udpc": Medium.UDP_SEND,
    "udpbcast": Medium.UDP_BROADCAST,
    "tcp": Medium.TCP_CONNECT,
    "tcpout": Medium.TCP_CONNECT,
    "tcpc": Medium.TCP_CONNECT,
    "tcpin": Medium.TCP_LISTEN,
    "tcps": Medium.TCP_LISTEN,
    "serial": Medium.SERIAL,
    "serial_flowcontrol": Medium.SERIAL,
}


def parse(text: str) -> Address:
    """Read one connection string.  Raises UserError, one line, for what it cannot mean."""
    if text.startswith("/"):
        return _serial(text, text)
    scheme, colon, rest = text.partition(":")
    if colon and scheme.isdigit() is False and scheme in SCHEMES:
        slashes = rest.startswith("//")
        rest = rest[2:] if slashes else rest
        medium = SCHEMES[scheme]
        if medium is Medium.SERIAL:
            return _serial(rest, text, flow_control=scheme == "serial_flowcontrol")
        address = _network(medium, rest, text)
        if scheme == "udp" and slashes:  # MAVSDK's old form: listens on an empty or any-host address, sends to others
            if address.host not in ("0.0.0.0", "::"):
                return Address(Medium.UDP_SEND, address.host, address.port, hint=f"{text} is outdated, read as udpout")
            return Address(Medium.UDP_LISTEN, address.host, address.port, hint=f"{text} is outdated, read as udpin")
        return address
    if "://" in text or not re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[\w.-]+):\d+", text):
        raise UserError(f"{text!r} is no connection string; for example {EXAMPLES}")
    return _network(Medium.UDP_LISTEN, text, text)  # pymavlink: bare host:port listens


def _network(medium: Medium, rest: str, text: str) -> Address:
    host, colon, port = rest.rpartition(":")
    host = host.strip("[]")
    if not colon or not port.isdecimal() or not 0 < int(port) <= 65535:
        raise UserError(f"{text!r} has no port between 1 and 65535; for example {EXAMPLES}")
    listens = medium in (Medium.UDP_LISTEN, Medium.TCP_LISTEN)
    if not host and listens:
        host = "0.0.0.0"
    if not listens and host in ANY_HOST:
        raise UserError(f"{text!r} names no host to talk to; for example udpout:127.0.0.1:{port}")
    return Address(medium, host, int(port))


def _serial(rest: str, text: str, *, flow_control: bool = False) -> Address:
    query = re.fullmatch(r"(?P<device>[^?]+)\?baudrate=(?P<baud>\d+)", rest)
    plain = re.fullmatch(r"(?P<device>/[^,]*?)(?:[,:](?P<baud>\d+))?", rest)
    match = query or plain
    if match is None:
        raise UserError(f"{text!r} is no serial device; for example /dev/ttyACM0,57600 or serial:///dev/ttyAMA0:921600")
    device, baud = match["device"], match["baud"]
    if baud is None and not USB_DEVICE.match(device):
        raise UserError(f"{text!r} does not say its speed, and a UART needs one; for example {device},57600")
    if baud is not None and not 0 < int(baud) <= FASTEST_BAUD:
        raise UserError(f"{text!r} has no speed between 1 and {FASTEST_BAUD} baud; for example {device},57600")
    return Address(Medium.SERIAL, device=device, baud=int(baud or DEFAULT_BAUD), flow_control=flow_control)
