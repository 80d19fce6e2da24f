"""The commands that train networks, complete maps and score completions, one a file; see
`scenegen.cli`."""
