"""What numpy raises on a damaged .npy or .npz: nearly anything, for it parses a header and inflates what follows."""

import tokenize
import zipfile
import zlib

UNREADABLE = (
    OSError,
    EOFError,
    LookupError,
    ValueError,
    TypeError,
    ArithmeticError,
    AttributeError,
    RuntimeError,
    MemoryError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
