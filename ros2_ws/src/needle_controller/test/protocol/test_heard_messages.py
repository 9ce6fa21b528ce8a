from __future__ import annotations

from needle_controller.protocol.heard_messages import HeardMessages, heard_messages


def test_what_was_heard_is_read_back_in_its_order_and_told_once() -> None:
    heard = HeardMessages()
    assert heard_messages(heard.take_text()) == []
    messages = [("joint_states", 1_700_000_000_000_000_000), ("needle/tip", 5), ("joint_states", 7)]
    for message in messages:
        heard.add(*message)
    assert heard_messages(heard.take_text()) == messages
    assert heard.take_text() == ""


def test_it_is_full_in_time() -> None:
    heard = HeardMessages()
    for number in range(1000):
        assert not heard.is_full or number >= 50
        heard.add("joint_states", number)
    assert heard.is_full
    heard.take_text()
    assert not heard.is_full


def test_foreign_text_is_no_message() -> None:
    found = heard_messages("joint_states soon, needle/tip -1, device/result 7, x 8 9")
    assert found == [("device/result", 7)]
