"""Updates of a robot's policy: two slots, signatures, and a pointer that is changed at once or not at all.

``SlotPolicy`` is what a robot controller opens; ``vlatool deploy``, ``rollback`` and ``status`` change a ``Store``.
Needs numpy and one inference engine, and ``cryptography`` where signatures are verified.
"""
