"""Results folder as a whole: held, read, counted, and written in the formats of the original benchmark."""
