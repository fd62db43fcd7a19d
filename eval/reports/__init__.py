"""Reports of a run: text, table and page, made of its folder alone; nothing is played."""
