"""Files and processes: own files, files of others within limits, stored JSON held to records, interrupts that wait."""
