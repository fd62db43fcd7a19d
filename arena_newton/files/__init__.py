"""Files and processes: own files written atomically, files of others read within limits, interrupts that wait."""
