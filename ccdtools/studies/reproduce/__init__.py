"""Both case studies of Tsai et al. as the paper describes them, row by row."""
