"""Check whether a recorded topic can be played with the installed message types."""

from __future__ import annotations

from needle_bags.format.message_definitions import full_definition, message_class, type_hash
from needle_core.errors import UserError
from needle_core.files.bag_topic import BagTopic


def unplayable(topic: BagTopic) -> str:
    """Return why a topic cannot be played; an empty text if it can."""
    try:
        installed = full_definition(topic.type_name)
        message_class(topic.type_name)
        installed_hash = type_hash(topic.type_name, installed)
        recorded_hash = topic.type_hash or (
            type_hash(topic.type_name, topic.definition) if topic.definition else installed_hash
        )
    except UserError as error:
        return str(error)
    except (ImportError, AttributeError, ValueError):
        return f"{topic.type_name} is not installed"
    if installed_hash != recorded_hash:
        return (
            f"{topic.type_name} has another definition in this bag than here (another "
            "ROS distribution): play it where it was recorded"
        )
    return ""
