"""Tests of errors match the code and the values in a sentence, never its words."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from poise.errors import PoiseError


@contextmanager
def refused(code: str, says: str | tuple[str, ...] = ()) -> Iterator[pytest.ExceptionInfo[PoiseError]]:
    """As `pytest.raises` for an error with this code.

    says: values that the sentence must contain as whole words: the number that was got, the name of a
        joint, of a setting or of a file, a line. The folder of a file does not count.
    """
    with pytest.raises(PoiseError) as caught:
        yield caught
    error = caught.value
    assert error.code == code, f"{error.code}: {error}"
    where = (error.where or "").rsplit("/", 1)[-1]
    sentence = f"{where}: {error.what}. {error.hint or ''}"
    for value in (says,) if isinstance(says, str) else says:
        begin, end = r"(?<!\w)" if value[:1].isalnum() else "", r"(?!\w)" if value[-1:].isalnum() else ""
        assert re.search(begin + re.escape(value) + end, sentence), f"'{value}' is not in: {sentence}"
