"""FITS CHECKSUM: ones' complement sums of 32-bit words, and their encoding."""

import numpy as np

__all__ = ["checksum_text", "sum_words"]

# Characters to avoid in a checksum: neither digits nor letters.
_PUNCTUATION = frozenset(b":;<=>?@[\\]^_`")
_WORDS_AT_A_TIME = 1 << 22


def sum_words(data, total=0):
    """Sum bytes as in the FITS standard (4.0, appendix J).

    Parameters
    ----------
    data : bytes
        A whole number of words of four bytes.
    total : int, optional
        Sum so far.

    Returns
    -------
    total : int
        Sum of 32 bits in ones' complement.
    """
    words = np.frombuffer(data, dtype=">u4")
    for start in range(0, len(words), _WORDS_AT_A_TIME):
        total += int(words[start : start + _WORDS_AT_A_TIME].sum(dtype=np.uint64))
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def checksum_text(total):
    """Encode the value of a CHECKSUM card that makes the sum of an HDU minus zero.

    Parameters
    ----------
    total : int
        Sum of the HDU with a CHECKSUM of sixteen zeros.

    Returns
    -------
    text : str
        Sixteen characters.
    """
    value = ~total & 0xFFFFFFFF
    columns = []
    for shift in (24, 16, 8, 0):
        quotient, rest = divmod(value >> shift & 0xFF, 4)
        # Four characters that add up to the byte, above "0".
        four = [quotient + 48 + (rest if k == 0 else 0) for k in range(4)]
        while any(character in _PUNCTUATION for character in four):
            for k in (0, 2):
                if four[k] in _PUNCTUATION or four[k + 1] in _PUNCTUATION:
                    four[k] += 1
                    four[k + 1] -= 1
        columns.append(four)
    text = "".join(chr(columns[byte][k]) for k in range(4) for byte in range(4))
    # Rotated by one character, because values of cards begin at the second byte of a word.
    return text[-1] + text[:-1]
