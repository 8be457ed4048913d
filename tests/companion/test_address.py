"""Every spelling that users of other MAVLink programs know, and what each of them means here."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.address import FASTEST_BAUD, Address, Medium, parse
from companion.errors import UserError

SPELLINGS = [
    # pymavlink
    ("udpin:0.0.0.0:14550", "udpin:0.0.0.0:14550"),
    ("udp:0.0.0.0:14550", "udpin:0.0.0.0:14550"),
    ("udp:127.0.0.1:14550", "udpin:127.0.0.1:14550"),
    ("127.0.0.1:14550", "udpin:127.0.0.1:14550"),
    ("localhost:14550", "udpin:localhost:14550"),
    ("udpin::14550", "udpin:0.0.0.0:14550"),
    ("udpout:127.0.0.1:14550", "udpout:127.0.0.1:14550"),
    ("udpout:gcs.example-1.org:14550", "udpout:gcs.example-1.org:14550"),
    ("udpbcast:192.168.1.255:14550", "udpbcast:192.168.1.255:14550"),
    ("tcp:127.0.0.1:5760", "tcp:127.0.0.1:5760"),
    ("tcpin:0.0.0.0:5760", "tcpin:0.0.0.0:5760"),
    ("tcpin::5760", "tcpin:0.0.0.0:5760"),
    ("/dev/ttyACM0", "serial:/dev/ttyACM0:57600"),
    # MAVProxy
    ("/dev/ttyACM0,57600", "serial:/dev/ttyACM0:57600"),
    ("/dev/ttyAMA0,921600", "serial:/dev/ttyAMA0:921600"),
    # MAVSDK
    ("udpin://0.0.0.0:14540", "udpin:0.0.0.0:14540"),
    ("udpout://192.168.1.12:14550", "udpout:192.168.1.12:14550"),
    ("udp://:14540", "udpin:0.0.0.0:14540"),
    ("udp://0.0.0.0:14540", "udpin:0.0.0.0:14540"),
    ("udp://192.168.1.12:14550", "udpout:192.168.1.12:14550"),
    ("tcpout://127.0.0.1:5760", "tcp:127.0.0.1:5760"),
    ("tcpin://0.0.0.0:5760", "tcpin:0.0.0.0:5760"),
    ("tcp://127.0.0.1:5760", "tcp:127.0.0.1:5760"),
    ("serial:///dev/ttyACM0:57600", "serial:/dev/ttyACM0:57600"),
    ("serial_flowcontrol:///dev/ttyAMA0:921600", "serial_flowcontrol:/dev/ttyAMA0:921600"),
    # mavlink-server, BlueOS
    ("udpserver://0.0.0.0:14550", "udpin:0.0.0.0:14550"),
    ("udps:0.0.0.0:14550", "udpin:0.0.0.0:14550"),
    ("udps://0.0.0.0:14550", "udpin:0.0.0.0:14550"),
    ("udpclient://127.0.0.1:14550", "udpout:127.0.0.1:14550"),
    ("udpc:127.0.0.1:14550", "udpout:127.0.0.1:14550"),
    ("tcpc:127.0.0.1:5760", "tcp:127.0.0.1:5760"),
    ("tcps:0.0.0.0:5760", "tcpin:0.0.0.0:5760"),
    ("serial:/dev/ttyACM0:115200", "serial:/dev/ttyACM0:115200"),
    ("serial:///dev/ttyAMA0?baudrate=115200", "serial:/dev/ttyAMA0:115200"),
    # names that do not change from boot to boot, colons and commas of their own included
    ("/dev/serial/by-id/usb-Hex_CubeOrange_1F0036-if00", "serial:/dev/serial/by-id/usb-Hex_CubeOrange_1F0036-if00:57600"),
    ("/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0", "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0:57600"),
    (
        "/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0,115200",
        "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0:115200",
    ),
    ("/dev/pts/3", "serial:/dev/pts/3:57600"),
    # IPv6
    ("udpin:[::]:14550", "udpin:[::]:14550"),
    ("[::1]:14550", "udpin:[::1]:14550"),
    ("udpout:[fe80::1]:14550", "udpout:[fe80::1]:14550"),
    ("udp://[::]:14540", "udpin:[::]:14540"),
    ("tcp:[::1]:5760", "tcp:[::1]:5760"),
]


@pytest.mark.parametrize(("text", "canonical"), SPELLINGS)
def test_every_spelling_has_one_meaning(text, canonical):
    assert parse(text).canonical == canonical


@pytest.mark.parametrize("canonical", sorted({canonical for _, canonical in SPELLINGS}))
def test_the_canonical_spelling_means_itself(canonical):
    address = parse(canonical)
    assert address.canonical == canonical
    assert address.hint == ""


WRONG = [
    "",
    "14550",
    ":14550",
    "udpin",
    "udpin:",
    "udpin:0.0.0.0",
    "udpin:0.0.0.0:",
    "udpin:0.0.0.0:0",
    "udpin:0.0.0.0:65536",
    "udpin:0.0.0.0:-1",
    "udpin:0.0.0.0:http",
    "udpin:0.0.0.0:1455²",
    "udpin://0.0.0.0:14550/",
    "UDPIN:0.0.0.0:14550",
    "http://127.0.0.1:80",
    "ws://127.0.0.1:14550",
    "tlog:flight.tlog",
    "udpout::14550",
    "udpout:0.0.0.0:14550",
    "udpout:[::]:14550",
    "udpout://0.0.0.0:14550",
    "tcp::5760",
    "tcp:0.0.0.0:5760",
    "udpbcast::14550",
    "local host:14550",
    "/dev/ttyAMA0",  # a UART must say its speed
    "/dev/ttyS0",
    "serial:///dev/ttyS0",
    "serial:ttyACM0",
    "serial:",
    "serial:///dev/ttyAMA0?baudrate=",
    "serial:///dev/ttyAMA0?baudrate=fast",
    "/dev/ttyACM0,",
    "/dev/ttyACM0,fast",
    "/dev/ttyAMA0,0",
    f"/dev/ttyAMA0,{FASTEST_BAUD + 1}",
]


@pytest.mark.parametrize("text", WRONG)
def test_what_means_nothing_is_the_users_mistake_told_in_one_line_with_an_example(text):
    with pytest.raises(UserError) as told:
        parse(text)
    line = str(told.value)
    assert "\n" not in line
    assert repr(text) in line
    assert "for example" in line


@pytest.mark.parametrize("text", ["udp://:14540", "udp://0.0.0.0:14540", "udp://192.168.1.12:14550"])
def test_outdated_spellings_are_understood_with_a_hint(text):
    assert text in parse(text).hint


def test_flow_control_is_asked_for_by_its_own_scheme():
    assert parse("serial_flowcontrol:///dev/ttyAMA0:921600").flow_control
    assert not parse("serial:///dev/ttyAMA0:921600").flow_control


def test_the_parts_of_an_address():
    assert parse("udpout:[fe80::1]:14550") == Address(Medium.UDP_SEND, "fe80::1", 14550)
    assert parse("/dev/ttyAMA0,921600") == Address(Medium.SERIAL, device="/dev/ttyAMA0", baud=921600)


@given(st.text(max_size=40) | st.text("udpintcosral:/.0123456789[],?=-", max_size=40))
def test_any_text_is_an_address_that_means_itself_or_a_mistake(text):
    mistake = ""
    try:
        address = parse(text)
    except UserError as told:
        mistake = str(told)
    assert len(mistake.splitlines()) <= 1
    assert mistake or parse(address.canonical).canonical == address.canonical
