from __future__ import annotations

import pytest

from needle_bags.format.topic_choice import TopicChoice
from needle_core.errors import UserError

TOPICS = ("/needle/tip", "/needle/tip_pose", "/stereo/left/image_raw", "/joint_states")


@pytest.mark.parametrize(
    ("choice", "chosen"),
    [
        (TopicChoice(), TOPICS),
        (TopicChoice(("/needle/tip",)), TOPICS[:1]),
        (TopicChoice(regex="^/needle/"), TOPICS[:2]),
        (TopicChoice(("/joint_states",), "tip$"), (TOPICS[0], TOPICS[3])),
        (TopicChoice(exclude_regex="image"), (TOPICS[0], TOPICS[1], TOPICS[3])),
        (TopicChoice(regex="needle", exclude_regex="pose"), TOPICS[:1]),
        (TopicChoice(("/stereo/left/image_raw",), "tip$", "image"), (TOPICS[0], TOPICS[2])),
    ],
)
def test_chosen(choice: TopicChoice, chosen: tuple[str, ...]) -> None:
    assert tuple(name for name in TOPICS if name in choice) == chosen


def test_what_is_no_expression_is_refused() -> None:
    with pytest.raises(UserError, match=r"'\(' is not a regular expression"):
        TopicChoice(exclude_regex="(")
