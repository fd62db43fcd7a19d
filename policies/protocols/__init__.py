"""Wire protocols between robots and policy servers: messages, codecs, checks and what a server declares."""
