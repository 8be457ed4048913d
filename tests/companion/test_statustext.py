"""Texts for people: whole characters in 50 bytes, the gravest first, never a flood."""

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from companion.dialect import definition, encode
from companion.events import Severity
from companion.frames import Splitter
from companion.statustext import BURST, CHUNK_BYTES, PREFIX, QUEUE, Speaker, chunks

S = 1_000_000
START_US = 1_700_000_000 * S
TEXTS = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=300)


def reassembled(pieces):
    """As a ground station does it, by the message's definition: a NUL in a chunk ends the text."""
    stream = Splitter()
    whole, ended = b"", False
    for seq, fields in enumerate(pieces):
        (frame,) = stream.feed(encode("STATUSTEXT", fields, sysid=1, compid=191, seq=seq))
        raw = frame.payload + bytes(definition(253).layout.size - len(frame.payload))
        text = raw[1 : 1 + CHUNK_BYTES]
        assert not ended
        assert frame.fields()["chunk_seq"] == seq
        whole += text.partition(b"\0")[0]
        ended = b"\0" in text
    return whole, ended


def test_a_text_of_fifty_bytes_is_one_message_without_a_chunk_id():
    assert chunks("x" * 50, Severity.CRITICAL, 7) == [{"severity": 2, "text": "x" * 50}]
    assert chunks("", Severity.INFO, 7) == [{"severity": 6, "text": ""}]


def test_a_text_of_fifty_one_bytes_is_two_chunks_of_one_id():
    assert chunks("x" * 50 + "y", Severity.WARNING, 7) == [
        {"severity": 4, "text": "x" * 50, "id": 7, "chunk_seq": 0},
        {"severity": 4, "text": "y", "id": 7, "chunk_seq": 1},
    ]


def test_an_exact_multiple_of_fifty_ends_with_an_empty_chunk():
    assert [piece["text"] for piece in chunks("x" * 100, Severity.INFO, 7)] == ["x" * 50, "x" * 50, ""]


def test_a_character_that_does_not_fit_goes_into_the_next_chunk_and_ends_nothing():
    pieces = chunks("x" * 49 + "ü" + "y" * 10, Severity.INFO, 7)
    assert [piece["text"] for piece in pieces] == ["x" * 49 + " ", "ü" + "y" * 10]


@given(TEXTS)
def test_every_chunk_is_whole_characters_and_the_text_comes_together_again(text):
    pieces = chunks(text, Severity.NOTICE, 9)
    assert all(len(piece["text"].encode()) <= CHUNK_BYTES for piece in pieces)
    if len(pieces) == 1:
        assert pieces[0]["text"] == text
        return
    assert {piece["id"] for piece in pieces} == {9}
    whole, ended = reassembled(pieces)
    assert ended
    assert all(len(piece["text"].encode()) == CHUNK_BYTES for piece in pieces[:-1])
    at, told = 0, whole.decode()
    for letter in told:  # nothing is lost or reordered; at most three spaces are put in at each seam
        if at < len(text) and letter == text[at]:
            at += 1
        else:
            assert letter == " "
    assert at == len(text)
    assert len(told) - len(text) <= 3 * (len(pieces) - 1)


@given(st.text(st.characters(min_codepoint=32, max_codepoint=126), min_size=51, max_size=300))
def test_plain_text_comes_together_unchanged(text):
    whole, ended = reassembled(chunks(text, Severity.NOTICE, 1))
    assert ended
    assert whole.decode() == text


def said(fields):
    return [piece["text"] for piece in fields]


def test_a_new_text_is_said_at_once_and_by_whom():
    assert said(Speaker().say("something is wrong", Severity.WARNING, START_US)) == [PREFIX + "something is wrong"]


def test_a_burst_goes_out_and_what_comes_on_top_follows_one_a_second():
    speaker = Speaker()
    now = [said(speaker.say(f"text {k}", Severity.INFO, START_US)) for k in range(8)]
    assert [len(texts) for texts in now] == [1] * BURST + [0] * 3
    later = [(ms, said(speaker.tick(START_US + ms * 1000))) for ms in range(0, 5000, 50)]
    out = [(ms, texts) for ms, texts in later if texts]
    assert [texts for _, texts in out] == [[f"{PREFIX}text {k}"] for k in (5, 6, 7)]
    assert all(right[0] - left[0] == 1000 for left, right in pairwise(out))
    assert speaker.dropped == 0


def test_never_more_texts_than_the_rate_allows_however_often_it_is_asked():
    speaker = Speaker()
    count = 0
    for ms in range(0, 60_000, 20):
        count += len(speaker.say(f"text {ms}", Severity.INFO, START_US + ms * 1000))
    assert count <= BURST + 60
    assert count >= 60


def test_silence_saves_up_no_more_than_one_burst():
    speaker = Speaker()
    speaker.say("first", Severity.INFO, START_US)
    count = sum(len(speaker.say(f"text {k}", Severity.INFO, START_US + 3600 * S)) for k in range(10))
    assert count == BURST


def test_the_gravest_of_what_waits_is_said_first_and_in_order_among_equals():
    speaker = Speaker()
    for k in range(BURST):
        speaker.say(f"fill {k}", Severity.INFO, START_US)
    for text, severity in (
        ("b", Severity.INFO),
        ("c", Severity.WARNING),
        ("a", Severity.EMERGENCY),
        ("d", Severity.WARNING),
    ):
        assert speaker.say(text, severity, START_US) == []
    assert said(speaker.tick(START_US + 10 * S)) == [PREFIX + text for text in "acdb"]


def test_the_queue_is_bounded_and_what_is_dropped_is_counted():
    speaker = Speaker()
    for k in range(BURST + QUEUE + 7):
        speaker.say(f"text {k}", Severity.INFO, START_US)
    assert speaker.dropped == 7
    out = [text for second in range(1, 100) for text in said(speaker.tick(START_US + second * S))]
    assert out == [f"{PREFIX}text {k}" for k in range(BURST, BURST + QUEUE)]


def test_a_full_queue_makes_room_for_what_is_graver():
    speaker = Speaker()
    for k in range(BURST + QUEUE):
        speaker.say(f"text {k}", Severity.INFO, START_US)
    assert speaker.say("PARAMETERS UNCERTAIN", Severity.EMERGENCY, START_US) == []
    assert speaker.dropped == 1
    assert said(speaker.tick(START_US + S)) == [PREFIX + "PARAMETERS UNCERTAIN"]


def test_texts_of_several_chunks_have_ids_of_their_own_that_never_are_zero():
    speaker = Speaker()
    ids = []
    for k in range(70_000):
        pieces = speaker.say("x" * 60, Severity.INFO, START_US + k * S)
        assert len(pieces) == 2
        ids.append(pieces[0]["id"])
    assert min(ids) == 1
    assert max(ids) == 0xFFFF
    assert all(left != right for left, right in pairwise(ids))
