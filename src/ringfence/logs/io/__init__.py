"""Files of other formats, read as logs."""
