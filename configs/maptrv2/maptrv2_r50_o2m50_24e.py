# MapTRv2 with 50 one-to-many queries, the baseline of GSMap's Table 3, which does not name k: 6 as in MapTRv2.
_base_ = './maptrv2_r50_24e.py'

model = dict(
    map_head=dict(
        query_groups=[dict(num=50), dict(name='one2many', num=50, repeats=6, weight=1.0)]))
