import pytest

from vlatool.files.printable import MAX_CHARACTERS, mask_passwords, message_of, one_line, printable, reason_of


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
    assert message_of(ValueError("z" * 10**7)) == "z" * MAX_CHARACTERS + "... (10,000,000 characters)"
    assert message_of(ValueError("z" * MAX_CHARACTERS)) == "z" * MAX_CHARACTERS
    assert message_of(_Mute()) == "(its text cannot be read: ValueError)"


SECRET = "s3cr3t"
ADDRESSES = (
    "postgresql://bob:s3cr3t@h/db",
    "--study=postgresql://bob:s3cr3t@h/db",
    "postgresql://bob@127.0.0.1:1/db?password=s3cr3t",
    "postgresql://h/db?user=x&pwd=s3cr3t&sslpassword=s3cr3t",
    "postgresql://bob:s3cr3t/pw@127.0.0.1:1/db",
    "postgresql://bob:s3cr3t pw@h/db",
    "postgresql://bob:x@s3cr3t@h/db",
    "postgresql://bob:a?b=s3cr3t@h/db",
    "postgresql://bob:s3cr3t",
    "postgresql:/bob:s3cr3t@h/db",
    "postgresql:bob:s3cr3t@h/db",
    "redis://:s3cr3t@h",
    "sqlite://bob:s3cr3t@h",
    "nothing+known://bob:s3cr3t@h",
)


@pytest.mark.parametrize("address", ADDRESSES)
def test_no_address_tells_its_password(address: str):
    assert SECRET not in mask_passwords(address)
    assert "***" in mask_passwords(address)


@pytest.mark.parametrize("text", [
    "trials.journal", "sqlite:///trials.db", "postgresql://host:5432/db", "policy.py:make", "user@host", "--hz=20",
    "a sentence: with a colon", "user@host:~/venv/bin/python", "relative_error=0.04",
])  # fmt: skip
def test_what_has_no_password_stays(text: str):
    assert mask_passwords(text) == text


@pytest.mark.parametrize(("message", "reason"), [
    ("Value error, a b", "a b"), ("Assertion failed, a", "a"), ("A Value error, a", "A Value error, a"), ("", ""),
])  # fmt: skip
def test_the_kind_of_error_is_left_out_of_a_reason(message: str, reason: str):
    assert reason_of(message) == reason
