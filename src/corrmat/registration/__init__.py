"""Registration of two clouds: `corrmat register` and what it is compared with."""
