"""What was made, to look at: a page that needs no network, pictures without a screen, and other
programs' formats."""
