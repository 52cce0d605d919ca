//! Sizes of files on the command line: `500000`, `100K`, `10M`, `1G`.

/// Parses a size in bytes, with K, M or G for powers of 1024; at least 1K.
pub(crate) fn parse(text: &str) -> Result<u64, &'static str> {
    let units = [('K', 1 << 10), ('M', 1 << 20), ('G', 1 << 30)];
    let unit = units.into_iter().find(|&(unit, _)| text.ends_with([unit, unit.to_ascii_lowercase()]));
    let (digits, factor) = unit.map_or((text, 1), |(_, factor)| (&text[..text.len() - 1], factor));
    let is_number = !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit());
    let bytes = digits.parse::<u64>().ok().filter(|_| is_number).and_then(|number| number.checked_mul(factor));
    bytes.filter(|&bytes| bytes >= 1 << 10).ok_or("expected a number of bytes from 1K, such as 500K, 20M or 2G")
}

#[cfg(test)]
mod tests {
    use super::parse;

    #[test]
    fn sizes_are_numbers_with_a_unit() {
        for (text, bytes) in [("1024", 1024), ("1K", 1024), ("500K", 512_000), ("20m", 20 << 20), ("2G", 2 << 30)] {
            assert_eq!(parse(text), Ok(bytes), "{text}");
        }
        for text in ["", "K", "5", "1023", "1.5M", "-1G", "+2K", "20000000000G", "1T", "1 M", "é", "1é"] {
            assert!(parse(text).is_err(), "{text}");
        }
    }
}
