"""One suite for every kind of link, back to back over the loopback; then what is particular to each.

Nothing sleeps: the tests wait on the links' own file descriptors, and the clock of `maintain` is an argument.
"""

import contextlib
import os
import pty
import select
import socket
import time
import tty

import pytest

from companion.address import Address, Medium, parse
from companion.errors import UserError
from companion.link import BUFFER_BYTES, PEERS, REOPEN_US, open_link

DEADLINE_S = 10.0


def free_port(kind=socket.SOCK_DGRAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Cable:
    """Two pseudo terminals, joined: what is written at one end can be read at the other."""

    def __init__(self):
        self.masters, self.devices, self._slaves = [], [], []
        for _ in range(2):
            master, slave = pty.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            self.masters.append(master)
            self._slaves.append(slave)  # held open: a master without a slave hangs up
            self.devices.append(os.ttyname(slave))
        self._waiting = [b"", b""]

    def carry(self):
        """Move what is there; never blocks."""
        for source, target in ((0, 1), (1, 0)):
            if not self._waiting[target]:
                with contextlib.suppress(BlockingIOError):
                    self._waiting[target] = os.read(self.masters[source], 4096)
            if self._waiting[target]:
                with contextlib.suppress(BlockingIOError):
                    written = os.write(self.masters[target], self._waiting[target])
                    self._waiting[target] = self._waiting[target][written:]

    def close(self):
        for handle in (*self.masters, *self._slaves):
            os.close(handle)


class Bench:
    """Two links of one kind, and the clock that `maintain` goes by."""

    def __init__(self, kind):
        self.cable = None
        self.now_us = 1_000_000_000
        if kind == "udp":
            port = free_port()
            texts = (f"udpin:127.0.0.1:{port}", f"udpout:127.0.0.1:{port}")
        elif kind == "tcp":
            port = free_port(socket.SOCK_STREAM)
            texts = (f"tcpin:127.0.0.1:{port}", f"tcp:127.0.0.1:{port}")
        else:
            self.cable = Cable()
            texts = tuple(f"serial:{device}:57600" for device in self.cable.devices)
        self.links = []
        for text in texts:
            self.links.append(open_link(parse(text)))
        self.here, self.there = self.links
        self.got = {id(link): [] for link in self.links}

    def turn(self):
        """Wait until something can be read, for a moment at most, and take it."""
        handles = [handle for link in self.links for handle in link.filenos()]
        if self.cable:
            handles += self.cable.masters
        select.select(handles, [], [], 0.02)
        if self.cable:
            self.cable.carry()
        for link in self.links:
            link.maintain(self.now_us)
            self.got[id(link)] += link.receive()

    def until(self, condition, what):
        give_up = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < give_up, f"waited in vain for {what}"
            self.turn()
        return self

    def bytes_at(self, link):
        return b"".join(data for _, data in self.got[id(link)])

    def arrives(self, link, data):
        return self.until(lambda: len(self.bytes_at(link)) >= len(data), f"{len(data)} bytes at {link.name}")

    def introduced(self):
        """Whoever connects has spoken, so that both know each other."""
        self.until(lambda: all(link.filenos() for link in self.links), "the connection")
        self.there.send(b"hello")
        self.arrives(self.here, b"hello")
        self.got[id(self.here)].clear()
        return self

    def close(self):
        for link in self.links:
            link.close()
        if self.cable:
            self.cable.close()


@pytest.fixture(params=["udp", "tcp", "serial"])
def bench(request):
    made = Bench(request.param)
    yield made
    made.close()


@pytest.fixture
def opened():
    """Opens links by their connection strings and closes them in the end."""
    links = []

    def open_one(text):
        links.append(open_link(parse(text)))
        return links[-1]

    yield open_one
    for link in links:
        link.close()


def waited(condition, *links, now_us=0):
    """Wait until the condition holds; -> what the links received meanwhile, each its list of (peer, data)."""
    give_up = time.monotonic() + DEADLINE_S
    out = [[] for _ in links]
    while True:
        for link, received in zip(links, out, strict=True):
            link.maintain(now_us)
            received += link.receive()
        if condition(*out):
            return out
        assert time.monotonic() < give_up, "waited in vain"
        select.select([handle for link in links for handle in link.filenos()], [], [], 0.02)


def numbered(count, size):
    """Messages that can be told apart and measured: number, length, filling."""
    return [k.to_bytes(4, "big") + size.to_bytes(2, "big") + bytes([k % 251]) * (size - 6) for k in range(count)]


def numbers(data):
    """The numbers of the messages in a stream of them.  Fails on anything that is no whole message."""
    found = []
    while data:
        number, size = int.from_bytes(data[:4], "big"), int.from_bytes(data[4:6], "big")
        assert data[:size] == number.to_bytes(4, "big") + size.to_bytes(2, "big") + bytes([number % 251]) * (size - 6)
        found.append(number)
        data = data[size:]
    return found


# -- every kind of link -----------------------------------------------------------------------------------------------


def test_bytes_arrive_whole_and_in_order_in_both_directions(bench):
    bench.introduced()
    sent = numbered(300, 280)
    for place in range(0, len(sent), 10):
        for data in sent[place : place + 10]:
            bench.here.send(data)
            bench.there.send(data)
        so_far = b"".join(sent[: place + 10])
        bench.arrives(bench.here, so_far).arrives(bench.there, so_far)
    assert bench.bytes_at(bench.here) == bench.bytes_at(bench.there) == b"".join(sent)
    assert bench.here.counts["send_errors"] == bench.there.counts["send_errors"] == 0


def test_nothing_to_read_is_nothing_at_once(bench):
    bench.introduced()
    for link in bench.links:
        assert link.receive() == []


def test_what_comes_names_its_peer_and_the_peer_can_be_answered(bench):
    bench.introduced()
    bench.there.send(b"question")
    bench.arrives(bench.here, b"question")
    (peer, data) = bench.got[id(bench.here)][0]
    assert data == b"question"
    bench.here.send(b"answer", peer)
    bench.arrives(bench.there, b"answer")
    assert bench.bytes_at(bench.there) == b"answer"


def test_names_are_canonical(bench):
    for link in bench.links:
        assert parse(link.name).canonical == link.name


def test_a_full_buffer_throws_away_whole_messages_only(bench):
    bench.introduced()
    size, count = 1000, 12_000
    for data in numbered(count, size):  # nobody reads
        bench.here.send(data)
    last = (2**31).to_bytes(4, "big") + (6).to_bytes(2, "big")
    give_up = time.monotonic() + DEADLINE_S
    while not bench.bytes_at(bench.there).endswith(last):
        assert time.monotonic() < give_up
        bench.here.send(last)
        bench.turn()
    got = [number for number in numbers(bench.bytes_at(bench.there)) if number != 2**31]
    assert got == sorted(set(got))
    assert 0 < len(got) < count
    if bench.here.name.startswith("udp"):
        return  # what the kernel drops of datagrams nobody tells us
    assert bench.here.counts["send_errors"] == count - len(got)
    assert len(got) * size >= BUFFER_BYTES - size


def test_a_peer_that_has_gone_is_no_reason_to_raise(bench):
    bench.introduced()
    bench.there.close()
    if bench.cable:
        bench.cable.close()
        bench.cable = None
    bench.links.remove(bench.there)
    for _ in range(50):
        bench.here.send(b"anybody?")
        bench.here.receive()
        bench.here.maintain(bench.now_us)


# -- UDP --------------------------------------------------------------------------------------------------------------


def test_a_listener_speaks_to_all_peers_it_has_learnt_or_to_one(opened):
    port = free_port()
    here = opened(f"udpin:127.0.0.1:{port}")
    one, other = opened(f"udpout:127.0.0.1:{port}"), opened(f"udpout:127.0.0.1:{port}")
    here.send(b"nobody is here yet")
    one.send(b"one")
    other.send(b"other")
    (received,) = waited(lambda got: len(got) == 2, here)
    peers = {data: peer for peer, data in received}
    here.send(b"all")
    here.send(b"one only", peers[b"one"])
    got_one, got_other = waited(lambda left, right: len(left) == 2 and len(right) == 1, one, other)
    assert [data for _, data in got_one] == [b"all", b"one only"]
    assert [data for _, data in got_other] == [b"all"]


def test_a_listener_forgets_the_peer_that_has_been_silent_for_longest(opened):
    port = free_port()
    here = opened(f"udpin:127.0.0.1:{port}")
    others = [opened(f"udpout:127.0.0.1:{port}") for _ in range(PEERS + 1)]
    for k, other in enumerate(others[:PEERS]):
        other.send(b"%d" % k)
        waited(lambda got: len(got) == 1, here)
    others[0].send(b"still here")
    waited(lambda got: len(got) == 1, here)
    others[PEERS].send(b"one more")
    waited(lambda got: len(got) == 1, here)
    here.send(b"all")
    rest = [other for k, other in enumerate(others) if k != 1]
    waited(lambda *got: all(len(each) == 1 for each in got), *rest)
    assert others[1].receive() == []


def test_a_broadcast_goes_to_everybody_until_somebody_answers(opened):
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        second = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        for hearer in (first, second):
            hearer.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            hearer.bind(("0.0.0.0", first.getsockname()[1]))
            hearer.settimeout(DEADLINE_S)
        port = first.getsockname()[1]
        caller = opened(f"udpbcast:127.255.255.255:{port}")
        caller.send(b"anybody?")
        data, caller_at = first.recvfrom(100)
        assert data == second.recv(100) == b"anybody?"
        first.sendto(b"here", caller_at)
        waited(lambda got: len(got) == 1, caller)
        caller.send(b"you")
        heard, _, _ = select.select([first, second], [], [], DEADLINE_S)
        assert [hearer.recv(100) for hearer in heard] == [b"you"]  # by one of them: it went to an address of its own


def test_empty_and_largest_datagrams_pass(opened):
    port = free_port()
    here, there = opened(f"udpin:127.0.0.1:{port}"), opened(f"udpout:127.0.0.1:{port}")
    there.send(b"")
    there.send(b"x" * 60_000)
    (received,) = waited(lambda got: len(got) == 2, here)
    assert [len(data) for _, data in received] == [0, 60_000]
    there.send(b"x" * 70_000)
    assert there.counts["send_errors"] == 1


# -- TCP --------------------------------------------------------------------------------------------------------------


def test_a_server_speaks_to_all_clients_or_to_one(opened):
    port = free_port(socket.SOCK_STREAM)
    here = opened(f"tcpin:127.0.0.1:{port}")
    one, other = opened(f"tcp:127.0.0.1:{port}"), opened(f"tcp:127.0.0.1:{port}")
    waited(lambda *_: one.filenos() and other.filenos() and len(here.filenos()) == 3, here, one, other)
    one.send(b"one")
    other.send(b"other")
    (received,) = waited(lambda got: len(got) == 2, here)
    peers = {data: peer for peer, data in received}
    assert peers[b"one"] != peers[b"other"]
    here.send(b"all.")
    here.send(b"one only", peers[b"one"])
    got_one, got_other = waited(
        lambda left, right: sum(len(data) for _, data in left) == 12 and sum(len(data) for _, data in right) == 4, one, other
    )
    assert b"".join(data for _, data in got_one) == b"all.one only"
    assert b"".join(data for _, data in got_other) == b"all."
    here.send(b"lost", ("127.0.0.1", 1))
    assert here.counts["send_errors"] == 1


def test_a_client_that_leaves_is_forgotten_by_the_server(opened):
    port = free_port(socket.SOCK_STREAM)
    here, there = opened(f"tcpin:127.0.0.1:{port}"), opened(f"tcp:127.0.0.1:{port}")
    waited(lambda *_: len(here.filenos()) == 2 and there.filenos(), here, there)
    there.send(b"last words")
    there.close()
    (received,) = waited(lambda _: len(here.filenos()) == 1, here)
    assert b"".join(data for _, data in received) == b"last words"


def test_a_client_waits_for_its_server_and_comes_back_when_it_was_away(opened):
    port = free_port(socket.SOCK_STREAM)
    there = opened(f"tcp:127.0.0.1:{port}")
    there.send(b"too early")
    assert there.counts["send_errors"] == 1
    give_up = time.monotonic() + DEADLINE_S
    while not there._next_us:  # refused: nobody listens
        there.maintain(0)
        assert time.monotonic() < give_up
    first = open_link(parse(f"tcpin:127.0.0.1:{port}"))
    there.maintain(REOPEN_US - 1)
    assert there.filenos() == []
    waited(lambda *_: len(first.filenos()) == 2 and there.filenos(), first, there, now_us=REOPEN_US)
    first.close()
    waited(lambda _: there.filenos() == [], there, now_us=-1)
    second = opened(f"tcpin:127.0.0.1:{port}")
    waited(lambda *_: len(second.filenos()) == 2 and there.filenos(), second, there, now_us=10 * REOPEN_US)
    there.send(b"back again")
    (received, _) = waited(lambda got, _: len(got) == 1, second, there)
    assert received[0][1] == b"back again"
    assert there.counts["connected"] == 2


# -- serial -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def device(tmp_path):
    """A device under a name that stays while what it points at changes, as /dev/serial/by-id does: -> plug(), unplug()."""
    name, handles = tmp_path / "ttyACM0", []

    def plug():
        master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        handles[:] = [master, slave]
        name.unlink(missing_ok=True)
        name.symlink_to(os.ttyname(slave))
        return master

    def unplug():
        for handle in handles:
            os.close(handle)
        handles.clear()
        name.unlink(missing_ok=True)

    yield name, plug, unplug
    unplug()


def read_from(master, count):
    got, give_up = b"", time.monotonic() + DEADLINE_S
    while len(got) < count:
        assert time.monotonic() < give_up
        if select.select([master], [], [], 0.02)[0]:
            got += os.read(master, 4096)
    return got


def test_a_device_that_comes_back_as_another_one_is_opened_again(device, opened):
    name, plug, unplug = device
    master = plug()
    port = opened(f"serial:{name}:57600")
    port.send(b"first")
    assert read_from(master, 5) == b"first"
    unplug()
    waited(lambda _: port.filenos() == [], port, now_us=-1)
    assert port.counts["lost"] == 1
    port.send(b"into the void")
    assert port.counts["send_errors"] == 1
    assert port.receive() == []
    port.maintain(0)  # still unplugged
    assert port.filenos() == []
    master = plug()
    port.maintain(REOPEN_US - 1)
    assert port.filenos() == []
    port.maintain(REOPEN_US)
    assert port.filenos()
    assert port.counts["reopened"] == 1
    port.send(b"second")
    assert read_from(master, 6) == b"second"
    os.write(master, b"third")
    (received,) = waited(lambda got: len(got) == 1, port)
    assert received == [(port.name, b"third")]


def test_what_was_waiting_for_a_device_that_went_away_is_not_sent_to_the_next(device, opened):
    name, plug, unplug = device
    plug()
    port = opened(f"serial:{name}:57600")
    for data in numbered(200, 1000):
        port.send(data)
    unplug()
    waited(lambda _: port.filenos() == [], port, now_us=-1)
    master = plug()
    port.maintain(REOPEN_US)
    fresh = numbered(3, 50)
    for data in fresh:
        port.send(data)
    assert read_from(master, 150) == b"".join(fresh)


def test_one_device_serves_one_program(device, opened):
    name, plug, _ = device
    plug()
    opened(f"serial:{name}:57600")
    with pytest.raises(UserError) as told:
        open_link(parse(f"serial:{name}:57600"))
    assert len(str(told.value).splitlines()) == 1


# -- what cannot work at all ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", ["udpin", "tcpin"])
def test_a_port_in_use_is_told_in_one_line(scheme, opened):
    port = free_port(socket.SOCK_DGRAM if scheme == "udpin" else socket.SOCK_STREAM)
    opened(f"{scheme}:127.0.0.1:{port}")
    with pytest.raises(UserError, match=f"^{scheme}:127.0.0.1:{port}: the port is in use .*choose another port$"):
        open_link(parse(f"{scheme}:127.0.0.1:{port}"))


@pytest.mark.parametrize("scheme", ["udpin", "udpout", "tcp", "tcpin"])
def test_an_unknown_host_is_told_in_one_line(scheme, monkeypatch):
    def nobody(*_args, **_kwargs):  # as a resolver answers, without asking one
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", nobody)
    with pytest.raises(UserError, match=r"^.*: host 'no\.such\.host\.invalid' is not known$"):
        open_link(parse(f"{scheme}:no.such.host.invalid:14550"))


def test_a_missing_device_is_told_in_one_line(tmp_path):
    with pytest.raises(UserError, match=f"^serial:{tmp_path}/ttyACM7:57600: there is no such device"):
        open_link(parse(f"serial:{tmp_path}/ttyACM7:57600"))


def test_a_file_that_is_no_device_is_told_in_one_line(tmp_path):
    (tmp_path / "notes.txt").write_text("no terminal")
    with pytest.raises(UserError) as told:
        open_link(Address(Medium.SERIAL, device=str(tmp_path / "notes.txt"), baud=57600))
    assert len(str(told.value).splitlines()) == 1
    assert "notes.txt" in str(told.value)


def test_an_address_of_another_machine_cannot_be_listened_on():
    with pytest.raises(UserError, match=r"^udpin:192\.0\.2\.1:14550: "):  # TEST-NET-1: nobody's
        open_link(parse("udpin:192.0.2.1:14550"))
