"""What receivers are told and how they answer: one file per language. Sans-I/O but for `port`, which a command line uses."""
