//! Text files as programs of forty years wrote them.

/// A file's text in any Unicode encoding, with line breaks of one kind. Bytes that are no text become `�`.
pub(crate) fn decode(bytes: &[u8]) -> String {
    let text = match bytes {
        [0xef, 0xbb, 0xbf, rest @ ..] => String::from_utf8_lossy(rest).into_owned(),
        [0xff, 0xfe, rest @ ..] => utf16(rest, u16::from_le_bytes),
        [0xfe, 0xff, rest @ ..] => utf16(rest, u16::from_be_bytes),
        // UTF-16 without a mark shows in the zero bytes of its first letters.
        [first, 0, second, 0, ..] if *first != 0 && *second != 0 => {
            utf16(bytes, u16::from_le_bytes)
        }
        [0, first, 0, second, ..] if *first != 0 && *second != 0 => {
            utf16(bytes, u16::from_be_bytes)
        }
        _ => String::from_utf8_lossy(bytes).into_owned(),
    };
    let text = text.replace("\r\n", "\n").replace('\r', "\n");
    // Ctrl-Z ended text files once.
    text.trim_end_matches(|c: char| c.is_whitespace() || c == '\u{1a}' || c == '\0')
        .to_owned()
}

fn utf16(bytes: &[u8], unit: fn([u8; 2]) -> u16) -> String {
    let units: Vec<u16> = bytes.as_chunks().0.iter().map(|pair| unit(*pair)).collect();
    String::from_utf16_lossy(&units)
}

#[cfg(test)]
mod tests {
    use super::decode;

    #[test]
    fn encodings_and_line_breaks_are_brought_to_one_kind() {
        let units: Vec<u16> = "ab\r\nc".encode_utf16().collect();
        let little: Vec<u8> = units.iter().flat_map(|u| u.to_le_bytes()).collect();
        let big: Vec<u8> = units.iter().flat_map(|u| u.to_be_bytes()).collect();
        for bytes in [
            b"ab\ncX".map(|b| if b == b'X' { 0x1a } else { b }).to_vec(),
            b"ab\rc".to_vec(),
            b"\xef\xbb\xbfab\r\nc\r\n".to_vec(),
            little.clone(),
            [&[0xff, 0xfe], little.as_slice()].concat(),
            big.clone(),
            [&[0xfe, 0xff], big.as_slice()].concat(),
        ] {
            assert_eq!(decode(&bytes), "ab\nc", "{bytes:?}");
        }
        assert_eq!(decode(b""), "");
    }
}
