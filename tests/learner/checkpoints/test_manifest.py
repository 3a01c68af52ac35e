"""A manifest round-trips, and everything else is refused with a sentence."""

import hashlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors.storage.fragment_writer import FileSum
from learner.checkpoints.manifest import (
    CheckpointError,
    Manifest,
    UnusableCheckpointError,
    decode_manifest,
    encode_manifest,
)

SUM = FileSum(3, "0" * 64)
PLAIN = st.text("abcXYZ019.-_ é", min_size=1, max_size=8).filter(lambda name: name not in (".", ".."))
NAMES = st.lists(PLAIN, min_size=1, max_size=4).map("/".join).filter(lambda name: name != "manifest.json")
SUMS = st.builds(FileSum, st.integers(0, 2**63), st.binary(min_size=32, max_size=32).map(bytes.hex))


def signed(values):
    """A manifest with a valid checksum of its own, as an attacker would write it."""
    text = json.dumps(values).encode()
    return text + b"\n" + hashlib.sha256(text).hexdigest().encode() + b"\n"


@given(env_steps=st.integers(0, 2**60), files=st.dictionaries(NAMES, SUMS, max_size=6), own=SUMS)
def test_round_trip(env_steps, files, own):
    files = {**files, "state.json": own}
    assert decode_manifest(encode_manifest(env_steps, files), "x") == Manifest(env_steps, files)


@pytest.mark.parametrize(
    "name",
    [
        "../outside",
        "a/../../b",
        "/etc/passwd",
        "a//b",
        "./a",
        "a/",
        "",
        ".",
        "..",
        "a\\..\\b",
        "a\0b",
        "manifest.json",
    ],
)
def test_a_name_that_leads_elsewhere_is_refused(name):
    with pytest.raises(UnusableCheckpointError, match="cannot be a file of a checkpoint"):
        decode_manifest(encode_manifest(1, {"state.json": SUM, name: SUM}), "x")


@pytest.mark.parametrize(
    "found",
    [None, 3, "0" * 64, [], [3], [3, "0" * 63], [3, "G" * 64], [-1, "0" * 64], [True, "0" * 64], [1.5, "0" * 64]],
)
def test_an_invalid_sum_is_refused(found):
    values = {"format": "shoal-checkpoint-5", "env_steps": 1, "files": {"state.json": [3, "0" * 64], "a": found}}
    with pytest.raises(UnusableCheckpointError, match="no length and SHA-256"):
        decode_manifest(signed(values), "x")


@pytest.mark.parametrize("files", [None, [], 7, "x", {}, {"other": [3, "0" * 64]}])
@pytest.mark.parametrize("env_steps", [1, -1, "1", None, True, 1.5])
def test_other_types_are_refused(files, env_steps):
    values = {"format": "shoal-checkpoint-5", "env_steps": env_steps, "files": files}
    with pytest.raises(UnusableCheckpointError, match="does not hold a manifest"):
        decode_manifest(signed(values), "x")


@given(st.binary(max_size=300))
def test_any_bytes_are_refused(data):
    with pytest.raises(CheckpointError):
        decode_manifest(data, "x")


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.text(), st.lists, max_leaves=20))
def test_any_signed_json_is_refused(values):
    with pytest.raises(CheckpointError):
        decode_manifest(signed(values), "x")


def test_endlessly_nested_json_is_refused():
    text = b"[" * 200_000
    with pytest.raises(UnusableCheckpointError):
        decode_manifest(text + b"\n" + hashlib.sha256(text).hexdigest().encode() + b"\n", "x")


@pytest.mark.parametrize(
    ("version", "error"), [(1, UnusableCheckpointError), (4, UnusableCheckpointError), (6, CheckpointError)]
)
def test_another_version_is_refused_by_name(version, error):
    with pytest.raises(CheckpointError, match=f"shoal-checkpoint-{version}.*shoal-checkpoint-5") as caught:
        decode_manifest(signed({"format": f"shoal-checkpoint-{version}"}), "runs/r")
    assert type(caught.value) is error


def test_every_flipped_bit_and_every_truncation_is_detected():
    whole = encode_manifest(7, {"state.json": SUM, "learner.safetensors": FileSum(99, "ab" * 32)})
    for place in range(len(whole)):
        for bit in range(8):
            damaged = bytearray(whole)
            damaged[place] ^= 1 << bit
            with pytest.raises(CheckpointError):
                decode_manifest(bytes(damaged), "x")
    for length in range(len(whole)):
        with pytest.raises(CheckpointError):
            decode_manifest(whole[:length], "x")
