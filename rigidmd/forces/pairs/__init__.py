"""Forces between pairs of sites: where sites are, which of them are near one another, and the one loop over them.

The words, from small to large, for lanes of width 4 (float64 with AVX2; 16 for float32 with AVX-512):

    site      an interaction point of a molecule, by its index i              `sites`: first, molecule, offsets
    slot      a place in the order in which sites are sorted in space          order[slot] = i, slot[i] = slot
    cluster   4 slots side by side, one vector of sites                        `clusters`

                  cluster c                    cluster c + 1
        slot    | 4c   4c+1 4c+2 4c+3        | ...
        local   | x x x x y y y y z z z z    | x x x x ...      relative to the origin of the cluster
                  `------' at 3 * 4 * c

    row       two slots (2r, 2r + 1) that are near one another; a cluster has 2 rows
    entry     a cluster and a periodic image of it: what a row meets, both its sites against all 4 of the other
    masked    an entry of which some lanes do not count: sites of one molecule, the cluster itself, the filled-up end
    shell     entries of a row in order of distance. Those of the first are within the cut-off when the list is built,
              those of shell k may come within it once sites have moved by k/14 of the skin: the loop ends there

        row r:   [ masked ... ] [ first shell | shell 1 | shell 2 | ... | shell 14 ]
                                  ^ always      ^ as far as sites have moved: `end_of_row`

    block     a share of the clusters, with its rows, its sums and its entries. Blocks are what threads take; their
              number does not depend on that of threads, and sums are added in the order of blocks: the same bits
    ring      clusters in their order, the last next to the first. A pair of clusters stands in the rows of the one from
              which it is less than half a round to the other, so each pair is met once

A list is kept as long as no site has moved by more than half the skin. `sites` and `space` say where things are, `tree`
finds clusters near one another, `lists` makes rows of them, `loop` computes.
"""
