"""What the software calls things when it speaks to a person: the same words on the page and in the terminal."""
