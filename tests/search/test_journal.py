"""Tests of the journal: evaluations are read back, even if a killed process left an incomplete record."""

import numpy as np
import pytest

from tuning.search.journal import Journal


def ask(journal, count, asked):
    """Return a list of the answers to `count` questions.

    asked: a list that receives the indices of the computed answers.
    """

    def compute(k):
        asked.append(k)
        return {"f": np.full(3, 1.0 / (k + 1)), "c": np.arange(6.0).reshape(2, 3) * k}

    return [journal.get(b"question %d" % k, lambda k=k: compute(k)) for k in range(count)]


def test_a_second_run_reads_the_journal_of_the_first_run(tmp_path):
    first, again, asked = [], [], []
    wrote = ask(Journal(tmp_path / "j"), 5, first)
    read = ask(Journal(tmp_path / "j"), 7, again)
    plain = ask(Journal(), 7, asked)
    assert (first, again, asked) == ([0, 1, 2, 3, 4], [5, 6], list(range(7)))
    for one, other in (*zip(wrote, read, strict=False), *zip(plain, read, strict=True)):
        assert one.keys() == other.keys() == {"f", "c"}
        for name, value in one.items():
            np.testing.assert_array_equal(value, other[name])
            assert value.dtype == other[name].dtype


def test_complete_records_of_a_truncated_journal_are_used(tmp_path):
    ask(Journal(tmp_path / "j"), 4, [])
    data = (tmp_path / "j").read_bytes()
    per_record = len(data) // 4  # all records have the same length
    for cut in (0, 3, 11, per_record - 1, per_record, per_record + 5, 3 * per_record + 7, len(data)):
        (tmp_path / "j").write_bytes(data[:cut])
        asked = []
        ask(Journal(tmp_path / "j"), 4, asked)
        assert asked == list(range(cut // per_record, 4))
        assert (tmp_path / "j").read_bytes() == data


@pytest.mark.parametrize("at", [0, 9, 30, 200])
def test_a_damaged_record_and_all_later_records_are_computed_again(tmp_path, at):
    ask(Journal(tmp_path / "j"), 3, [])
    data = bytearray((tmp_path / "j").read_bytes())
    record = len(data) // 3
    data[record + at] ^= 0x40
    (tmp_path / "j").write_bytes(data)
    asked = []
    ask(Journal(tmp_path / "j"), 3, asked)
    assert asked == [1, 2]


def test_another_question_replaces_all_later_records_of_the_journal(tmp_path):
    """A question is the input of an evaluation, and its record has the answer."""
    ask(Journal(tmp_path / "j"), 4, [])
    journal, asked = Journal(tmp_path / "j"), []
    journal.get(b"question 0", dict)
    journal.get(b"another", lambda: {"f": np.ones(1)})
    ask(Journal(tmp_path / "j"), 1, asked)
    assert asked == []
    replayed = Journal(tmp_path / "j")
    replayed.get(b"question 0", dict)
    np.testing.assert_array_equal(replayed.get(b"another", dict)["f"], np.ones(1))
    assert replayed.get(b"question 2", dict) == {}  # no earlier record is left


def test_reading_a_journal_does_not_change_its_file(tmp_path):
    """An incomplete record of a killed process is removed only when the next evaluation is recorded."""
    ask(Journal(tmp_path / "j"), 3, [])
    data = (tmp_path / "j").read_bytes()
    (tmp_path / "j").write_bytes(data[:-5])
    ask(Journal(tmp_path / "j"), 2, [])
    assert (tmp_path / "j").read_bytes() == data[:-5]


def test_records_of_other_questions_are_removed_only_after_the_answer_is_computed(tmp_path):
    def interrupt():
        raise KeyboardInterrupt

    ask(Journal(tmp_path / "j"), 3, [])
    data = (tmp_path / "j").read_bytes()
    journal = Journal(tmp_path / "j")
    with pytest.raises(KeyboardInterrupt):
        journal.get(b"another", interrupt)
    assert (tmp_path / "j").read_bytes() == data
