"""A short run of benchmarks/fuzz.py: mutated artifacts and settings load or are refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tree import ROOT

from sb3_follow_object.common.array_trees import load_tree, save_tree
from sb3_follow_object.common.plain_yaml import load_yaml


def test_mutated_artifacts_are_loaded_or_refused_in_one_sentence(tmp_path: Path) -> None:
    out = tmp_path / "found.json"
    # In a process of its own, whose memory is limited.
    command = [sys.executable, str(ROOT / "benchmarks" / "fuzz.py"), "--out", str(out)]
    done = subprocess.run([*command, "--files", "300", "--seed", "7"], capture_output=True)
    found = json.loads(out.read_text())
    assert found["bad"] == []
    assert done.returncode == 0
    assert sum(found["outcomes"].values()) == 300


@settings(max_examples=200, deadline=None)
@given(st.text(max_size=200))
def test_any_text_is_yaml_or_refused(text: str) -> None:
    try:
        load_yaml(text)
    except ValueError as error:
        assert "\n" not in str(error)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text() | st.integers(), inner),
    max_leaves=20,
)


@settings(max_examples=50, deadline=None)
@given(VALUES)
def test_plain_trees_come_back_as_they_were(tmp_path_factory, tree: object) -> None:
    path = tmp_path_factory.getbasetemp() / "tree.safetensors"
    save_tree(path, tree)
    assert load_tree(path) == tree


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("&a [*a]", "contains itself"),
        ("[" * 2000, "nested more than 32 deep"),
        ("[" * 40 + "]" * 40, "nested more than 32 deep"),
        ("a: !!binary aGk=", "it holds a bytes"),
        ("a: 2020-01-01", "it holds a date"),
        ("1: x", "1 is a key, where keys must be text"),
        ("a: !!python/name:os.system", "could not determine a constructor"),
        ("x" * 200_000, "has 200000 characters"),
        ("a: " + "9" * 5000, "4300"),
        ("a: 1\nb: 2\n'a': 3", "^'a' is given in line 1 and again in line 3$"),
        ("x: [{y: 1, y: 2}]", "^'y' is given in line 1 and again in line 1$"),
    ],
)
def test_yaml_that_is_not_plain_is_refused(text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        load_yaml(text)


@pytest.mark.parametrize("line", ["[{}]", "{{<<: [{}]}}"])
def test_aliases_cannot_multiply_without_bound(line: str) -> None:
    lines = ["a: &a {x: 1}", "b0: &b0 " + line.format(", ".join(["*a"] * 9))]
    for n in range(1, 9):
        lines.append(f"b{n}: &b{n} " + line.format(", ".join([f"*b{n - 1}"] * 9)))
    with pytest.raises(ValueError, match="aliases stand for more than"):
        load_yaml("\n".join(lines))
    assert load_yaml("a: &a {x: 1}\nb: {<<: *a, y: 2}")["b"] == {"x": 1, "y": 2}


def test_what_is_merged_may_be_given_again() -> None:
    text = "a: &a {x: 1, y: 1}\nb: &b {<<: *a, x: 2}\nc: {<<: [*a, *b], y: 3}\nd: {<<: *a, <<: *b}"
    found = load_yaml(text)
    assert found["b"] == {"x": 2, "y": 1}
    assert found["c"] == {"x": 1, "y": 3}
    assert found["d"].keys() == {"x", "y"}
