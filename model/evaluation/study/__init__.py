"""What stands beside the paper's two tables when the bench is asked to study: why a row is as good
or bad as it is.

The paper's protocol answers how well each method does. Here its choices vary one at a time,
failures are told apart by what the method knew, and errors by where they lie.
"""
