"""The commands that make datasets and look at them, one a file: parse, call one function, print.

What a command needs is imported inside it, so that its help is instant.
"""
