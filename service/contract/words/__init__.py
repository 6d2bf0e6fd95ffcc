"""The software's words for people: the same on the page and in the terminal."""
