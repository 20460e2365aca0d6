"""The one error type that means "your input is wrong"."""


class InputError(ValueError):
    """Bad input: a file, a configuration, an argument.

    The message is one line and says what must be what. Command lines print it without a traceback.
    """
