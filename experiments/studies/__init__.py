"""One module a paper: run its studies, then draw and judge what they found."""
