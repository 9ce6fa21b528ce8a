from __future__ import annotations

import pytest

from needle_bags.format.topic_choice import TopicChoice
from needle_core.errors import UserError

TOPICS = ("/needle/tip", "/needle/tip_pose", "/stereo/left/image_raw", "/joint_states")


def test_topics_are_selected_by_name_and_expression() -> None:
    for choice, chosen in (
        (TopicChoice(), TOPICS),
        (TopicChoice(("/needle/tip",)), TOPICS[:1]),
        (TopicChoice(("/joint_states",), "tip$"), (TOPICS[0], TOPICS[3])),
        (TopicChoice(exclude_regex="image"), (TOPICS[0], TOPICS[1], TOPICS[3])),
        (TopicChoice(regex="needle", exclude_regex="pose"), TOPICS[:1]),
        (TopicChoice(("/stereo/left/image_raw",), "tip$", "image"), (TOPICS[0], TOPICS[2])),
    ):
        assert tuple(name for name in TOPICS if name in choice) == chosen
    with pytest.raises(UserError, match=r"'\(' is not a regular expression"):
        TopicChoice(exclude_regex="(")
