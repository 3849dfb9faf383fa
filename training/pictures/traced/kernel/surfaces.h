// Colour and height of surfaces: barks, sawn ends, soils, leaves, paint; moss, lichen and snow upon them.
#pragma once
#include "vector.h"

enum Kind { SCALY, PLATED, FURROWED, BIRCH, SMOOTH, PEELED, WILD, EARTH, LEAVES, STONES, NEEDLES, LEAF, PAINT, GROUND };

struct Soil { float kind, scale, warp, spare; V3 tones[4]; float count, wild[7]; };
struct Look {
    float kind, seed, scale, relief, moss, lichen, snow, wet;
    float rings, heart, dirt, radius, bast, patch, snow_scale, puddles;
    float wild[8];
    V3 tones[4], ends[3], moss_tones[2], lichen_tone;
    Soil first, second;
};
struct Shade { V3 colour; float height; float rough; };

HD V3 stretched(V3 p, float along, float s) { return v3(p.x + s, p.y + 1.7f * s, along * p.z + 0.6f * s); }

// Layers with random stretch, threshold and weight: barks and soils that nobody named.
HD float wild_height(V3 p, const float* w, float scale, int fewer) {
    V3 a3 = v3(p.x, p.y, w[0] * p.z);
    float bend = w[1] * perlin(3.0f * a3);
    a3 = v3(a3.x + bend, a3.y + bend, a3.z);
    float a = fbm((scale * w[2]) * a3, 4 - fewer, 0.55f);
    float b = fbm((scale * w[3]) * v3(p.x + 7, p.y, w[4] * p.z), 3 - fewer, 0.6f);
    float c = w[5] > 0 ? cells((scale * w[6]) * a3).y : 0.0f;
    return a * 0.6f + step2(b, 0.45f, 0.45f + w[7]) * 0.4f + w[5] * (fminf(c, 0.5f) - 0.25f);
}

HD Shade bark(const Look& k, V3 p, int kind, int fewer) {
    float s = k.seed, h = 0.0f;
    V3 colour = v3(0, 0, 0);
    if (kind == SCALY) {
        V3 q = stretched(p, 0.55f, s);
        h = 0.6f * cells((45.0f * k.scale) * q).x + fbm((28.0f * k.scale) * q, 4 - fewer, 0.65f);
        colour = ramp(k.tones, 3, h, 0.45f, 1.1f);
    } else if (kind == PLATED) {
        V3 q = stretched(p, 0.28f, s);
        float w = 0.05f * perlin(9.0f * q);
        float edge = step2(cells((17.0f * k.scale) * v3(q.x + w, q.y - w, q.z + w)).y, 0.03f, 0.3f);
        float fine = fbm(40.0f * stretched(p, 0.4f, s), 4 - fewer, 0.65f);
        h = edge + 0.4f * fine;
        colour = mix(k.tones[0], ramp(k.tones + 1, 2, fine, 0.35f, 0.65f), edge);
    } else if (kind == FURROWED) {
        V3 q = stretched(p, 0.13f, s);
        float w = 0.02f * perlin(25.0f * q);
        h = fbm((24.0f * k.scale) * v3(q.x + w, q.y + w, q.z), 5 - fewer, 0.65f);
        colour = ramp(k.tones, 3, h, 0.33f, 0.67f);
    } else if (kind == BIRCH) {
        float dash = fbm((5.0f * k.scale) * stretched(p, 9.0f, s), 3 - fewer, 0.6f);
        float fine = fbm((3.0f * k.scale) * stretched(p, 22.0f, s + 5), 3 - fewer, 0.5f);
        float dark = fmaxf(step2(dash, 0.6f, 0.66f), 0.8f * step2(fine, 0.62f, 0.66f));
        float patch = step2(fbm(4.5f * stretched(p, 0.6f, s + 2), 4 - fewer, 0.65f), 0.6f, 0.66f);
        colour = mix(ramp(k.tones + 1, 2, fbm(6.0f * stretched(p, 3.0f, s + 1), 4 - fewer, 0.5f), 0.35f, 0.65f), k.tones[0],
                     fmaxf(dark, patch));
        h = 1.0f - 0.8f * patch;
    } else if (kind == SMOOTH) {
        float spot = step2(cells((9.0f * k.scale) * stretched(p, 0.7f, s)).x, 0.2f, 0.1f);
        h = fbm(5.0f * stretched(p, 3.5f, s), 5 - fewer, 0.55f);
        colour = mix(ramp(k.tones + 1, 2, h, 0.35f, 0.65f), k.tones[0], 0.85f * spot);
        h += spot;
    } else if (kind == PEELED) {
        float streak = fbm((22.0f * k.scale) * stretched(p, 0.05f, s), 4 - fewer, 0.6f);
        float rest = step2(fbm(5.0f * stretched(p, 0.25f, s + 4), 5 - fewer, 0.6f), 0.56f, 0.6f);
        colour = mix(ramp(k.tones + 1, 2, streak, 0.35f, 0.65f), k.tones[0], rest * k.bast);
        h = streak + rest;
    } else {
        h = wild_height(v3(p.x + s, p.y - s, p.z + s), k.wild, 14.0f * k.scale, fewer);
        colour = ramp(k.tones, 3, h, 0.3f, 0.75f);
    }
    Shade r = {colour, h, 0.9f};
    return r;
}

HD Shade soil(const Soil& k, V3 p, float s, int fewer) {
    V3 q = v3(p.x + s, p.y - s, p.z);
    float w = 0.1f * k.warp * perlin(2.0f * q);
    float fine = fbm((26.0f * k.scale) * v3(q.x + w, q.y - w, q.z), 5 - fewer, 0.68f), h;
    int kind = (int)k.kind, n = (int)k.count;
    V3 colour;
    if (kind == LEAVES) {
        V3 c = cells((34.0f * k.scale) * q);
        h = fine - 0.6f * c.x;
        colour = mix(ramp(k.tones, n, c.z, 0.1f, 0.9f), ramp(k.tones, n, fine, 0.35f, 0.65f), 0.5f);
    } else if (kind == STONES) {
        h = step2(cells((22.0f * k.scale) * q).y, 0.0f, 0.3f) + 0.5f * fine;
        colour = ramp(k.tones, n, h, 0.25f, 1.3f);
    } else if (kind == NEEDLES) {
        float b = 0.4f * perlin(3.0f * q);
        float one = fbm(60.0f * v3(q.x + b, 0.12f * q.y, q.z), 3 - fewer, 0.6f), two = fbm(60.0f * v3(0.12f * q.x, q.y + b, q.z), 3 - fewer, 0.6f);
        h = 0.8f * fmaxf(one, two) + 0.4f * fine;
        colour = ramp(k.tones, n, h, 0.45f, 0.9f);
    } else if (kind == WILD) {
        h = wild_height(q, k.wild, 6.0f * k.scale, fewer);
        colour = mix(ramp(k.tones, n, h, 0.3f, 0.75f), ramp(k.tones, n, fine, 0.3f, 0.7f), 0.4f);
    } else {
        h = 0.5f * fbm((5.0f * k.scale) * q, 4 - fewer, 0.6f) + 0.5f * fine;
        colour = ramp(k.tones, n, h, 0.33f, 0.67f);
    }
    Shade r = {colour, h, 0.95f};
    return r;
}

HD V3 covered(const Look& k, V3 colour, V3 w, float up, int fewer) {
    float s = k.seed;
    if (k.lichen > 0) {
        float spots = step2(fbm(9.0f * v3(w.x + s, w.y, w.z), 4 - fewer, 0.55f), 0.72f - 0.2f * k.lichen, 0.75f);
        colour = mix(colour, k.lichen_tone, 0.8f * spots);
    }
    if (k.moss > 0) {
        float patch = fbm(4.0f * v3(w.x + s, w.y - s, w.z), 4 - fewer, 0.5f);
        float share = step2(0.35f * up + patch, 0.95f - 0.45f * k.moss, 1.0f);
        colour = mix(colour, ramp(k.moss_tones, 2, fbm(90.0f * w, 2 - fewer, 0.5f), 0.35f, 0.65f), share);
    }
    if (k.snow > 0) {
        float patch = fbm(3.0f * v3(w.x - s, w.y + s, w.z), 4 - fewer, 0.5f);
        colour = mix(colour, v3(0.86f, 0.9f, 0.95f), step2(up + patch, 1.75f - 0.75f * k.snow, 1.8f - 0.7f * k.snow));
    }
    return colour;
}

// p in the body's frame (a log's z is along it), w in the world, up: the vertical part of the normal.
// fewer: octaves of noise to leave out, for light from the side; bare: only the height is wanted.
HD Shade surface(const Look& k, bool end, V3 p, V3 w, float up, uint32_t body, int fewer, bool bare) {
    int kind = (int)k.kind;
    if (end) {
        float r = sqrtf(p.x * p.x + p.y * p.y) / k.radius, bend = 0.12f * perlin(9.0f * v3(p.x, p.y, k.seed));
        float ring = 0.5f + 0.5f * sinf(6.2832f * k.rings * (r + bend) * k.radius * 2.0f);
        V3 colour = mix(k.ends[0], k.ends[1], ring);
        colour = mix(colour, k.ends[2], k.heart * step2(r, 0.55f, 0.35f));
        colour = mix(colour, k.tones[0], step2(r, 0.9f, 0.95f));
        colour = (1.0f - k.dirt * step2(fbm(7.0f * v3(p.x, p.y, k.seed), 4 - fewer, 0.6f), 0.6f, 0.35f)) * colour;
        Shade out = {covered(k, colour, w, up, fewer), 0.2f * ring, 0.9f - 0.3f * k.wet};
        return out;
    }
    if (kind == LEAF || kind == PAINT) {
        float own = kind == LEAF ? (scrambled(body * 2654435761u) & 1023u) / 1023.0f : 0.5f;
        float n = fbm((kind == LEAF ? 12.0f : 5.0f * k.scale) * p, 3 - fewer, 0.6f);
        Shade out = {ramp(k.tones, 3, kind == LEAF ? 0.6f * own + 0.4f * n : n, 0.15f, 0.85f), n, 0.9f};
        if (k.snow > 0 && kind == PAINT) out.colour = covered(k, out.colour, w, up, fewer);
        return out;
    }
    if (kind == GROUND) {
        V3 at = v3(w.x + k.seed, w.y - k.seed, w.z);
        float share = step2(fbm(k.patch * at, 5 - fewer, 0.62f), 0.45f, 0.57f);
        Shade one = {v3(0, 0, 0), 0, 0.95f}, two = one;
        if (share < 1) one = soil(k.first, w, k.seed, fewer);
        if (share > 0) two = soil(k.second, w, k.seed + 4, fewer);
        Shade out = {mix(one.colour, two.colour, share), one.height + share * (two.height - one.height), 0.97f - 0.35f * k.wet};
        if (!bare) out.colour = (0.55f + 0.45f * step2(fbm(0.5f * at, 3 - fewer, 0.5f), 0.3f, 0.65f)) * out.colour;
        if (k.snow > 0) {
            float cover = step2(fbm(k.snow_scale * v3(w.x, w.y + k.seed, w.z), 5 - fewer, 0.6f), 0.72f - 0.5f * k.snow, 0.75f - 0.48f * k.snow);
            float crust = fbm(30.0f * w, 3 - fewer, 0.6f);
            out.colour = mix(out.colour, mix(v3(0.86f, 0.9f, 0.95f), v3(0.55f, 0.58f, 0.65f), 0.5f * crust - 0.1f), cover);
            out.height = mix(v3(out.height, 0, 0), v3(0.8f + 0.3f * crust, 0, 0), cover).x;
        }
        if (k.puddles > 0 && !bare) {
            float water = step2(fbm(0.9f * at, 3 - fewer, 0.5f), 0.6f, 0.63f);
            out.colour = mix(out.colour, v3(0.02f, 0.018f, 0.014f), 0.8f * water);
            out.rough -= 0.6f * water;
        }
        return out;
    }
    Shade out = bark(k, p, kind, fewer);
    if (bare) return out;
    float uneven = fbm(1.6f * v3(p.x + k.seed, p.y, p.z), 3 - fewer, 0.5f);
    out.colour = (0.65f + 0.35f * step2(uneven, 0.3f, 0.6f)) * out.colour;
    out.colour = covered(k, out.colour, w, up, fewer);
    out.rough = 0.95f - 0.6f * k.wet;
    return out;
}
// How deep the relief of a kind is [m].
HD float relief(const Look& k) {
    int kind = (int)k.kind;
    float d = kind == PLATED ? 0.012f : kind == FURROWED || kind == WILD ? 0.014f : kind == GROUND ? 0.025f : kind == LEAF ? 0.0f : 0.005f;
    return d * k.relief;
}
