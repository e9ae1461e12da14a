"""The one root exception of the library.

Everything that can go wrong with a caller's data raises :class:`SkyfixError` with a one-line message that names the
thing, what was expected and what came. Command lines print that line and nothing else.
"""


class SkyfixError(Exception):
    """Bad input, or a request that cannot be met; the message is one line, ready to show to a person."""
