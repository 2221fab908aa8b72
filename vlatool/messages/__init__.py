"""Messages that robots exchange: one definition each, from which every encoding, hash and text is derived."""

from vlatool.messages.schema import Message, all_types, find_type, same

__all__ = ["Message", "all_types", "find_type", "same"]
