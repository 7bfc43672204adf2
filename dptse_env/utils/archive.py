"""Zip archives of unknown origin, read with bounds."""

import io
import zipfile

MOST_ENTRIES = 1000
"""Largest number of entries in an archive."""

_DIRECTORY_SIGNATURE = b"PK\x01\x02"


def open_archive(content: bytes) -> zipfile.ZipFile:
    """Return an archive with a directory of limited length.

    Raises:
        ValueError: It has too many entries.
        zipfile.BadZipFile: It is no zip archive, or damaged.
    """
    if content.count(_DIRECTORY_SIGNATURE) > MOST_ENTRIES:
        raise ValueError(f"it has more than {MOST_ENTRIES} entries")
    return zipfile.ZipFile(io.BytesIO(content))


def read_entry(archive: zipfile.ZipFile, name: str, largest: int) -> bytes:
    """Return the content of an entry; the size in its header is not relied on.

    Raises:
        ValueError: It has more than `largest` bytes, or another compression than deflate.
        KeyError: There is no such entry.
    """
    entry = archive.getinfo(name)
    # Other methods decompress the complete content at once, however large it is.
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"entry {name!r} must be stored or deflated")
    with archive.open(entry) as file:
        content = file.read(largest + 1)
    if len(content) > largest:
        raise ValueError(f"entry {name!r} has more than {largest} bytes")
    return content
