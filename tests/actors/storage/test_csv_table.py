"""Tables of named tuples as CSV: any type of row, refused with its file and line."""

from typing import NamedTuple

import pytest

from actors.storage.csv_table import read_csv, write_csv
from sim_core.checks import ConfigError


class Fruit(NamedTuple):
    name: str
    count: int
    mass_kg: float


PEAR, PLUM = Fruit("pear, green", 3, 0.25), Fruit("plum", 2, 1e-9)


def test_rows_come_back_sorted_with_their_types(tmp_path):
    path = tmp_path / "new" / "fruits.csv"
    write_csv(path, Fruit, [PLUM, PEAR])
    found = read_csv(path, Fruit, "fruits", "plant some")
    assert found == [PEAR, PLUM] and [type(value) for value in found[0]] == [str, int, float]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name,count\npear,3\n", "is no table of fruits: its first line must be name,count,mass_kg"),
        ("name,count,mass_kg\npear,3,1\nplum,two,1\n", "fruits.csv, line 3 is no row of fruits"),
        ("name,count,mass_kg\npear,3\n", "line 2 is no row of fruits"),
        (None, "cannot be read .*; plant some"),
    ],
)
def test_anything_else_is_refused(tmp_path, text, words):
    path = tmp_path / "fruits.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=words):
        read_csv(path, Fruit, "fruits", "plant some")
