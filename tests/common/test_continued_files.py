"""Log files are cut back to what they held."""

import pytest

from sb3_belief.common.continued_files import cut_file, cut_table, sync_file

TABLE = b"a,b\n1,2\n3,4\n"


def test_a_file_is_cut_to_its_first_bytes(tmp_path):
    path = tmp_path / "monitor.csv"
    path.write_bytes(b"12345")
    for size in (4, 4, 0):
        cut_file(path, size)
        assert path.read_bytes() == b"1234"[:size]
    with pytest.raises(ValueError, match=r"monitor.csv is not the log of this run any more: it has 0 bytes, and had 1"):
        cut_file(path, 1)


@pytest.mark.parametrize(
    ("later", "keys", "before"),
    [
        (TABLE, ["a", "b"], TABLE),
        (TABLE + b"5,6\n7,", ["a", "b"], TABLE),
        # Two times new columns came, which SB3 marks by commas at the ends of the rows
        (b"a,b,c,d,e\n1,2,,,\n3,4,,,\n5,6,,,\n7,8,9,,\n,,,,1\n", ["a", "b"], TABLE),
        (b"a,b,c\n1,2,\n3,4,\n", ["a", "b"], TABLE),
        # Rows that ended by empty cells then keep them
        (b"a,b,c\n1,,\n", ["a", "b"], b"a,b\n1,\n"),
        (b"a,b,c\r\n1,2,\r\n3,4,5\r\n", ["a", "b"], b"a,b\r\n1,2\r\n"),
        # A text of two lines, which SB3 takes for two rows
        (b'a,b,c\n1,"x,\ny",\n', ["a", "b"], None),
        (TABLE, [], b""),
    ],
)
def test_a_table_is_cut_to_its_first_columns_and_rows(tmp_path, later, keys, before):
    path = tmp_path / "progress.csv"
    path.write_bytes(later)
    if before is None:
        with pytest.raises(ValueError, match="first rows"):
            cut_table(path, keys, 11)
        assert path.read_bytes() == later
        return
    cut_table(path, keys, len(before))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a,c,b\n1,,2\n3,,4\n", r"its columns do not begin with \['a', 'b'\]"),
        (b"a,b,c\n1,2,3\n3,4,\n", "its first rows are not those of the 12 bytes"),
        (b"a,b,c\n1,2,\n", "its first rows are not those of the 12 bytes"),
        (b"a,b\n1,2\n", "it has 8 bytes, and had 12"),
    ],
)
def test_the_table_of_another_run_is_refused(tmp_path, content, message):
    path = tmp_path / "progress.csv"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        cut_table(path, ["a", "b"], len(TABLE))
    assert path.read_bytes() == content


def test_a_file_is_synced(tmp_path, monkeypatch):
    synced = []
    (tmp_path / "a").touch()
    monkeypatch.setattr("os.fsync", lambda descriptor: synced.append(descriptor))
    sync_file(tmp_path / "a")
    assert len(synced) == 1
