"""YAML files without duplicate keys."""

from __future__ import annotations

from pathlib import Path

import pytest

from needle_core.errors import UserError
from needle_core.files.yaml_files import load_yaml, read_yaml


def test_a_duplicate_key_is_named_with_its_line() -> None:
    for text, key, line in (
        ("a: 1\na: 2", "a", 2),
        ("b:\n  - {a: 1}\n  - a: 1\n    c: [a, a]\n    a: 2", "a", 5),
        ("b: {a: {a: 1}, c: {a: 1}}\nc: a\n'b': 1", "b", 3),
        ("? [a]\n: 1\nb: 2\n? b\n: 3", "b", 4),
    ):
        with pytest.raises(ValueError, match=f"^duplicate key '{key}' in line {line}$"):
            load_yaml(text)


def test_an_unreadable_file_is_a_one_line_error(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    for content, words in (
        (None, "cannot be read: No such file"),
        (b"[1, 2", "not YAML in line 2"),
        (b"a: !!opencv-matrix {}", "not YAML in line 1"),
        (b"a: 2024-13-45", "month must be in"),
        (b"\xff\xfe\xff", "cannot be read: not a text file"),
    ):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(UserError) as caught:
            read_yaml(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)
