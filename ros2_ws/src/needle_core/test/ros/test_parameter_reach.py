"""What is said to reach a node is what rclpy gives it."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.context import Context
from rclpy.node import Node

from needle_core.errors import UserError
from needle_core.settings.parameter_files import check_command_line, sections_for, values_for

KIND = "device_driver"
NAMES = (
    *("device_driver", "/device_driver", "other", "/rig1/device_driver", "rig1/device_driver"),
    *("/rig1/other", "/rig2/device_driver", "/a/b/device_driver", "/**", "/*", "/*/*", "/rig1/*"),
    *("/rig1/**", "/a/**", "/**/device_driver", "/**/other", "/*/device_driver", "**", "/**/b/*"),
    *("/rig1/**/device_driver", "/**/rig1/device_driver", "/a/*/device_driver", "**/device_driver"),
)
REMAPPINGS = (
    (),
    ("-r", "__ns:=/rig1"),
    ("-r", "__ns:=/a/b"),
    ("-r", "__node:=other"),
    ("-r", "device_driver:__node:=other", "-r", "other:__ns:=/rig1"),
    ("-r", "__ns:=/rig1", "-r", "device_driver:__ns:=/a"),
    ("-r", "somebody:__ns:=/rig1"),
)


def overrides(words: Sequence[str]) -> tuple[str, dict[str, object]]:
    """Return the full name of a node that is started so, and the parameters it was given."""
    context = Context()
    context.init(["node", *words])
    try:
        node = Node(KIND, context=context, start_parameter_services=False, enable_rosout=False)
        given = {name: one.value for name, one in node._parameter_overrides.items()}
        name = node.get_fully_qualified_name()
        node.destroy_node()
    finally:
        context.try_shutdown()
    return name, given


@pytest.mark.parametrize("remapping", REMAPPINGS)
def test_the_same_sections_reach_the_node(tmp_path: Path, remapping: Sequence[str]) -> None:
    sections = {name: {f"p{i}": i, "last": i} for i, name in enumerate(NAMES)}
    file = tmp_path / "p.yaml"
    file.write_text("".join(f"'{n}': {{ros__parameters: {v}}}\n" for n, v in sections.items()))
    name, given = overrides(["--ros-args", "--params-file", str(file), *remapping])
    assert given == values_for(file, sections, name, KIND)
    assert given.keys() - {"last"} == {
        parameter
        for section in sections_for(file, sections, name, KIND)
        for parameter in sections[section]
        if parameter != "last"
    }


# Sections of up to two files, and where -p stands between them.
FILES = st.lists(
    st.lists(st.sampled_from(["/**", KIND, "/device_driver"]), max_size=3, unique=True), max_size=2
)


@settings(deadline=None, max_examples=60)
@given(FILES, st.integers(0, 2), st.sampled_from(["", f"{KIND}:"]))
def test_an_override_passes_exactly_if_it_reaches_the_node(
    files: list[list[str]], place: int, of: str
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        words = []
        for number, names in enumerate(files):
            file = Path(folder, f"{number}.yaml")
            lines = [f"'{n}': {{ros__parameters: {{a: {number}{i}}}}}" for i, n in enumerate(names)]
            if {KIND, "/device_driver"} <= set(names):
                lines = lines[:1]
            file.write_text("\n".join(lines))
            words.append(("--params-file", str(file)))
        words.insert(place, ("-p", f"{of}a:=99"))
        line = ["--ros-args", *(word for pair in words for word in pair)]
        name, given = overrides(line)
        if given["a"] == 99:
            check_command_line([KIND, *line], name)
        else:
            with pytest.raises(
                UserError, match=r"-p .*a:=99 does not reach /device_driver, section"
            ):
                check_command_line([KIND, *line], name)
