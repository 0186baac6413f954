import gzip
import lzma
import tarfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.errors import InputError
from sim.formats.text import read_bytes, read_members, split_words


@settings(max_examples=300, deadline=None)
@given(st.lists(st.floats(allow_nan=False), min_size=1, max_size=20))
def test_numbers_are_read_exactly(numbers):
    for form in (repr, "{:.6f}".format, "{:.3e}".format, "{:.17g}".format):
        words = [form(x) for x in numbers]
        found = split_words(" ".join(words).encode(), "f")
        assert found.values.tolist() == [float(word) for word in words]
        assert found.is_number.all()


@pytest.mark.parametrize("text", ["1 2\n", "# a comment\n1 2\n", "ODOM 1 2\n", ""])
def test_a_byte_order_mark_is_passed_over(text):
    plain, marked = split_words(text.encode(), "f"), split_words(text.encode("utf-8-sig"), "f")
    np.testing.assert_array_equal(marked.values, plain.values)
    assert marked.lines_by_keyword == plain.lines_by_keyword


@settings(max_examples=500, deadline=None)
@given(st.text("0123456789.eE+-infaINF#,; \n\txX", max_size=60))
def test_words_are_numbers_where_python_says_so(text):
    words = split_words(text.encode(), "f")
    expected = []
    for line in text.replace(",", " ").replace(";", " ").split("\n"):
        expected += line.split("#")[0].split()
    assert len(words.values) == len(expected)
    for word, value, is_number in zip(expected, words.values, words.is_number, strict=True):
        try:
            number = float(word)
        except ValueError:
            assert not is_number
        else:
            if word.lower().lstrip("+-") == "infinity":
                continue
            assert is_number
            assert value == number or (np.isnan(value) and np.isnan(number))


def test_lines_keywords_and_columns():
    words = split_words(b"# head\n\nODOM 1 2\nODOMX 3\n  ODOM 4, x # rest\nODOM", "f")
    np.testing.assert_array_equal(words.line_numbers, [3, 4, 5, 6])
    lines = words.lines_of("ODOM")
    np.testing.assert_array_equal(lines, [0, 2, 3])
    np.testing.assert_array_equal(words.numbers(lines[:2], 1, 1, "x")[:, 0], [1.0, 4.0])
    with pytest.raises(InputError, match=r"^f:5: not a number in pose"):
        words.numbers(lines[:2], 1, 2, "pose")
    with pytest.raises(InputError, match=r"^f:6: too few words for pose"):
        words.numbers(lines, 1, 1, "pose")


def test_columns_that_differ_by_line():
    words = split_words(b"a 1 2 3\nb 4 5 6\n", "f")
    found = words.numbers(np.array([0, 1]), np.array([1, 2]), 2, "x")
    np.testing.assert_array_equal(found, [[1, 2], [5, 6]])


def test_a_binary_file_is_refused():
    with pytest.raises(InputError, match=r"^f:2: holds a zero byte"):
        split_words(b"1 2\n3 \x00 4\n", "f")


def test_not_finite_and_not_whole():
    words = split_words(b"1 inf\n2.5 3\n", "f")
    with pytest.raises(InputError, match=r"^f:1: x must be finite"):
        words.table(2, "x")
    with pytest.raises(InputError, match=r"^f:2: n must be a whole number from 0 to 9"):
        words.whole(np.arange(2), 0, "n", 0, 9)


@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress, bytes])
def test_packed_files(tmp_path, pack):
    path = tmp_path / "log"
    data = b"1 2 3\n" * 1000
    path.write_bytes(pack(data) + (pack(data) if pack is not bytes else b""))
    assert read_bytes(path) == data * (2 if pack is not bytes else 1)


@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress])
def test_cut_and_damaged_archives(tmp_path, pack):
    path = tmp_path / "log"
    whole = pack(bytes(np.random.default_rng(0).integers(256, size=5000, dtype=np.uint8)))
    for data in (whole[:-20], whole[:100], whole[:40] + b"\xff" * 40 + whole[80:]):
        path.write_bytes(data)
        with pytest.raises(InputError, match="cannot read"):
            read_bytes(path)


@pytest.mark.parametrize("pack", [gzip.compress, lzma.compress])
def test_an_archive_that_would_fill_the_memory(tmp_path, pack):
    path = tmp_path / "bomb"
    path.write_bytes(pack(bytes(30 << 20)))
    with pytest.raises(InputError, match="more than"):
        read_bytes(path, most_bytes=1 << 20)


def test_members_of_folder_and_archive(tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "a.dat").write_bytes(b"1")
    (tmp_path / "set" / "b.dat.gz").write_bytes(gzip.compress(b"2"))
    assert read_members(tmp_path / "set") == {"a.dat": b"1", "b.dat": b"2"}
    with tarfile.open(tmp_path / "set.tar.xz", "w:xz") as archive:
        archive.add(tmp_path / "set" / "a.dat", "set/a.dat")
    assert read_members(tmp_path / "set.tar.xz") == {"a.dat": b"1"}
    (tmp_path / "none.tar").write_bytes(b"nothing" * 200)
    with pytest.raises(InputError, match="not a tar archive"):
        read_members(tmp_path / "none.tar")
    with pytest.raises(InputError, match="cannot read"):
        read_members(tmp_path / "absent.tar")
