"""Messages that robots exchange: one definition each, from which every encoding, hash and text is derived."""

from vlatool.messages.schema import Message, find_type, same

__all__ = ["Message", "find_type", "same"]
