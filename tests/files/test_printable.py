import pytest

from vlatool.files.printable import message_of, one_line, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain", "plain"), ("Grüße, 机器人 🤖", "Grüße, 机器人 🤖"), ("a\nb\tc", "a\nb\tc"), ("\x1b[2J", "\\x1b[2J"),
        ("\x9b2J", "\\x9b2J"), ("a\rb", "a\\rb"), ("\x00", "\\x00"), ("\u202eabc", "\\u202eabc"), ("\ud800", "\\ud800"),
        ("\x07\x08\x7f", "\\x07\\x08\\x7f"), ("\u2028", "\\u2028"), ("\u2066x", "\\u2066x"),
    ],
)  # fmt: skip
def test_what_moves_the_cursor_or_hides_text_is_written_out(text: str, shown: str) -> None:
    assert printable(text) == shown
    printable(text).encode()


def test_a_line_is_one_line_of_a_bounded_length() -> None:
    assert one_line(" a\n\n b\t\x1b") == "a b \\x1b"
    assert len(one_line("x " * 10_000, 50)) == 50


class _Mute(Exception):
    def __str__(self) -> str:
        raise ValueError("no")


def test_an_exception_without_a_text_is_told():
    assert message_of(ValueError("a")) == "a"
    assert message_of(ValueError("\udcff")) == "?"
    assert message_of(_Mute()) == "(its text cannot be told: ValueError)"
