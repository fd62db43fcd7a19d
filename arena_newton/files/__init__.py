"""Files and processes: own files written atomically, files of others read within limits, stored JSON held to records, interrupts."""
