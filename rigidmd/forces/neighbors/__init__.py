"""Forces between pairs of sites: where sites are, which of them are near one another, and the one
loop over them.

The terms, from small to large, for vectors of 4 lanes (float64 with AVX2; float32 with AVX-512 has
16):

    site      an interaction point of a molecule, with index i. `sites`: first, molecule, offsets
    slot      a position in the spatial order of the sites: order[slot] = i, slot[i] = slot
    cluster   4 consecutive slots, one vector of sites. `clusters`

                  cluster c                    cluster c + 1
        slot    | 4c   4c+1 4c+2 4c+3        | ...
        local   | x x x x y y y y z z z z    | x x x x ...
                  `------' at 3 * 4 * c       relative to the origin of the cluster

    row       two slots (2r, 2r + 1) near one another. A cluster has 2 rows
    entry     a cluster and one periodic image of it, in a row: both sites of the row interact with
              its 4 sites
    masked    an entry with lanes that are omitted: sites of the same molecule, the cluster itself,
              padding at the end
    shell     entries of a row at similar distance. The first shell is within the cutoff when the
              list is built; shell k may come within it once sites have moved by k/14 of the skin

        row r:   [ masked ... ] [ first shell | shell 1 | shell 2 | ... | shell 14 ]
                                  ^ always      ^ the loop ends here, see `end_of_row`

    block     a range of clusters, with its rows, sums and entries. A thread takes one block at a
              time. Their number does not depend on the number of threads, and sums are added in the
              order of blocks: the same bits
    ring      the clusters in order, with the first after the last. A pair of clusters is stored
              with the one from which it is less than half way round to the other, so each pair is
              stored once

A list is valid as long as no site has moved by more than half the skin. `sites` and `space` have
positions and cells, `clusters` sorts sites, `tree` finds clusters near one another, `lists` has the
list, `update` rebuilds it, `rows` fills it, `pair_loop` computes the forces.
"""
