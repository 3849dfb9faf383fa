// A small path tracer: triangles in a tree of boxes, sun, sky, lamps, two bounces; for a GPU or one CPU thread.
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <vector>
#include "surfaces.h"

struct Tri { V3 a, b, c; };
struct Fine { V3 na, nb, nc; int look, body, end; };
struct Node { V3 low, high; int first, count; };  // count 0: children at first and first + 1
struct Body { float turn[9]; V3 at; int number; };  // turn: world to body
struct Lamp { V3 at, way, tone; float edge; };
struct Light {
    V3 zenith, horizon, below, sun_way, sun_tone; float sun_edge, glow;
    float backdrop, backdrop_height, backdrop_seed; V3 trees; float lamps; Lamp lamp[4];
};
struct View { V3 eye, right, down, ahead; float fx, fy, cx, cy; int w, h, samples; uint32_t seed; };
struct World { const Tri* tris; const Fine* fine; const Node* nodes; const Body* bodies; const Look* looks; };
struct Hit { float t, u, v; int tri; };

HD bool in_box(const Node& n, V3 o, V3 inv, float far) {
    float ax = (n.low.x - o.x) * inv.x, bx = (n.high.x - o.x) * inv.x, ay = (n.low.y - o.y) * inv.y, by = (n.high.y - o.y) * inv.y;
    float az = (n.low.z - o.z) * inv.z, bz = (n.high.z - o.z) * inv.z;
    float near = fmaxf(fmaxf(fminf(ax, bx), fminf(ay, by)), fmaxf(fminf(az, bz), 0.0f));
    return near <= fminf(fminf(fmaxf(ax, bx), fmaxf(ay, by)), fminf(fmaxf(az, bz), far));
}
HD bool cast(const World& w, V3 o, V3 d, float far, bool any, Hit& hit) {
    V3 inv = v3(1.0f / (fabsf(d.x) > 1e-9f ? d.x : 1e-9f), 1.0f / (fabsf(d.y) > 1e-9f ? d.y : 1e-9f), 1.0f / (fabsf(d.z) > 1e-9f ? d.z : 1e-9f));
    int stack[48], top = 0;
    stack[top++] = 0;
    hit.t = far;
    hit.tri = -1;
    while (top) {
        const Node& n = w.nodes[stack[--top]];
        if (!in_box(n, o, inv, hit.t)) continue;
        if (n.count) {
            for (int i = n.first; i < n.first + n.count; i++) {
                const Tri& q = w.tris[i];
                V3 e = q.b - q.a, f = q.c - q.a, p = cross(d, f);
                float det = dot(e, p);
                if (fabsf(det) < 1e-14f) continue;
                V3 s = o - q.a;
                float u = dot(s, p) / det;
                if (u < 0 || u > 1) continue;
                V3 r = cross(s, e);
                float v = dot(d, r) / det, t = dot(f, r) / det;
                if (v < 0 || u + v > 1 || t < 1e-4f || t >= hit.t) continue;
                hit.t = t; hit.u = u; hit.v = v; hit.tri = i;
                if (any) return true;
            }
        } else if (top < 46) { stack[top++] = n.first; stack[top++] = n.first + 1; }
    }
    return hit.tri >= 0;
}
HD V3 sky(const Light& l, V3 d) {
    float up = d.z;
    if (l.backdrop > 0) {  // a forest's edge far away: crowns, and trunks before a dark inside
        float way = atan2f(d.y, d.x);
        V3 q = v3(6.0f * cosf(way), 6.0f * sinf(way), l.backdrop_seed);
        float rim = l.backdrop_height * (0.6f + 0.8f * (fbm(q, 4, 0.6f) - 0.2f));
        if (up < rim && up > -0.12f) {
            float crown = fbm(v3(9.0f * q.x, 9.0f * q.y, 40.0f * up + l.backdrop_seed), 4, 0.65f);
            float trunk = step2(perlin(v3(22.0f * q.x, 22.0f * q.y, 1.5f * up)), 0.22f, 0.32f) * step2(up, 0.7f * rim, 0.3f * rim);
            V3 c = (0.25f + 1.5f * clamp1(crown - 0.25f)) * l.trees;
            return mix(c, 0.9f * (l.horizon * v3(0.3f, 0.25f, 0.2f)), 0.7f * trunk);
        }
    }
    V3 c = up > 0 ? mix(l.horizon, l.zenith, sqrtf(up)) : mix(l.horizon, l.below, fminf(1.0f, -6.0f * up));
    float near = dot(d, l.sun_way);
    return near > 0 ? c + (l.glow * powf(near, 24.0f)) * l.sun_tone : c;
}
HD V3 around(V3 n, Rng& r) {  // cosine-weighted
    float a = 6.2831853f * next(r), z = 2.0f * next(r) - 1.0f, s = sqrtf(fmaxf(0.0f, 1.0f - z * z));
    return unit(n + v3(s * cosf(a), s * sinf(a), z));
}
HD V3 to_body(const Body& b, V3 p) {
    V3 q = p - b.at;
    const float* m = b.turn;
    return v3(m[0] * q.x + m[1] * q.y + m[2] * q.z, m[3] * q.x + m[4] * q.y + m[5] * q.z, m[6] * q.x + m[7] * q.y + m[8] * q.z);
}
HD float height_at(const Look& k, bool end, const Body& b, V3 w, float up, int body) { return surface(k, end, to_body(b, w), w, up, body, 0, true).height; }

HD V3 trace(const World& w, const Light& l, V3 o, V3 d, Rng& r) {
    V3 sum = v3(0, 0, 0), left = v3(1, 1, 1);
    for (int bounce = 0; bounce < 3; bounce++) {
        Hit h;
        if (!cast(w, o, d, 1e4f, false, h)) {
            V3 s = sky(l, d);
            return sum + left * s;
        }
        if (bounce == 2) return sum + left * (0.12f * (l.horizon + l.zenith));  // what further bounces would bring
        const Tri& q = w.tris[h.tri];
        const Fine& f = w.fine[h.tri];
        const Look& k = w.looks[f.look];
        const Body& b = w.bodies[f.body];
        V3 p = o + h.t * d, flat = unit(cross(q.b - q.a, q.c - q.a));
        V3 n = unit((1.0f - h.u - h.v) * f.na + h.u * f.nb + h.v * f.nc);
        if (dot(flat, d) > 0) flat = -1.0f * flat;
        if (dot(n, flat) < 0) n = -1.0f * n;
        Shade s = surface(k, f.end, to_body(b, p), p, n.z, f.body, bounce ? 3 : 0, false);
        float deep = relief(k);
        if (deep > 0 && bounce == 0) {
            V3 x = unit(fabsf(n.z) < 0.9f ? cross(n, v3(0, 0, 1)) : cross(n, v3(1, 0, 0))), y = cross(n, x);
            float eps = fmaxf(0.0015f, 0.0012f * h.t);
            float gx = height_at(k, f.end, b, p + eps * x, n.z, f.body) - s.height, gy = height_at(k, f.end, b, p + eps * y, n.z, f.body) - s.height;
            n = unit(n - (deep / eps * gx) * x - (deep / eps * gy) * y);
            if (dot(n, d) > -0.02f) n = unit(n - (dot(n, d) + 0.05f) * d);
        }
        bool through = (int)k.kind == LEAF && next(r) < 0.3f;
        V3 side = through ? -1.0f * n : n, face = through ? -1.0f * flat : flat, out = p + 2e-4f * face;
        if (s.rough < 0.9f) {  // wet: a coat that mirrors at flat angles
            float c = clamp1(-dot(n, d)), fresnel = 0.03f + 0.97f * powf(1.0f - c, 5.0f);
            if (next(r) < fresnel * (1.0f - s.rough)) {
                d = unit(d - (2.0f * dot(n, d)) * n + (0.5f * s.rough) * around(n, r));
                if (dot(d, flat) < 0.01f) break;
                o = p + 2e-4f * flat;
                continue;
            }
        }
        left = left * s.colour;
        Hit shadow;
        V3 way = unit(l.sun_way + l.sun_edge * v3(next(r) - 0.5f, next(r) - 0.5f, next(r) - 0.5f));
        float facing = dot(side, way);
        if (l.sun_tone.x > 0 && facing > 0 && dot(face, way) > 0 && !cast(w, out, way, 1e4f, true, shadow)) sum = sum + left * (facing * l.sun_tone);
        if (l.lamps > 0) {
            int i = (int)(next(r) * l.lamps);
            V3 to = l.lamp[i].at - p;
            float far = sqrtf(dot(to, to));
            to = (1.0f / far) * to;
            float cone = step2(-dot(to, l.lamp[i].way), l.lamp[i].edge, l.lamp[i].edge + 0.2f);
            facing = dot(side, to);
            if (cone > 0 && facing > 0 && dot(face, to) > 0 && !cast(w, out, to, far - 0.01f, true, shadow))
                sum = sum + left * ((l.lamps * facing * cone / (far * far)) * l.lamp[i].tone);
        }
        o = out;
        d = around(side, r);
        if (dot(d, face) < 0) d = d - (2.0f * dot(d, face)) * face;
    }
    return sum;
}
HD void pixel(const World& w, const Light& l, const View& v, int i, float* rgb, float* depth, uint8_t* ids) {
    int x = i % v.w, y = i / v.w;
    Rng r = {scrambled((uint32_t)i * 9781u ^ v.seed)};
    V3 mean = v3(0, 0, 0);
    for (int k = 0; k <= v.samples; k++) {
        bool exact = k == v.samples;
        float px = x + (exact ? 0.0f : next(r) + next(r) - 1.0f), py = y + (exact ? 0.0f : next(r) + next(r) - 1.0f);
        V3 d = ((px - v.cx) / v.fx) * v.right + ((py - v.cy) / v.fy) * v.down + v.ahead;
        if (exact) {
            Hit h;
            bool hit = cast(w, v.eye, d, 1e4f, false, h);
            depth[i] = hit ? h.t : NAN;
            ids[i] = hit ? (uint8_t)w.bodies[w.fine[h.tri].body].number : 0;
            break;
        }
        V3 c = trace(w, l, v.eye, unit(d), r);
        float most = fmaxf(c.x, fmaxf(c.y, c.z));
        if (!(most < 1e6f)) continue;
        mean = mean + (most > 20.0f ? 20.0f / most : 1.0f) * c;
    }
    rgb[3 * i] = mean.x / v.samples; rgb[3 * i + 1] = mean.y / v.samples; rgb[3 * i + 2] = mean.z / v.samples;
}
#ifdef __CUDACC__
__global__ void pixels(World w, Light l, View v, float* rgb, float* depth, uint8_t* ids) {
    int i = blockIdx.x * blockDim.x + threadIdx.x, n = v.w * v.h;
    if (i < n) pixel(w, l, v, i, rgb, depth, ids);
}
template <class T> static T* moved(const T* p, size_t n) { T* q; if (cudaMalloc(&q, n * sizeof(T)) != cudaSuccess) return nullptr; cudaMemcpy(q, p, n * sizeof(T), cudaMemcpyHostToDevice); return q; }
#endif

struct Scene { std::vector<Tri> tris; std::vector<Fine> fine; std::vector<Node> nodes; std::vector<Body> bodies; std::vector<Look> looks; World world; bool on_gpu; };

static void grow(V3& low, V3& high, V3 p) {
    low = v3(std::min(low.x, p.x), std::min(low.y, p.y), std::min(low.z, p.z));
    high = v3(std::max(high.x, p.x), std::max(high.y, p.y), std::max(high.z, p.z));
}
static float area(V3 low, V3 high) { V3 e = high - low; return e.x < 0 ? 0.0f : e.x * e.y + e.y * e.z + e.z * e.x; }
// Binned surface-area heuristic, with a loop instead of recursion.
static void build(Scene& s) {
    int n = (int)s.tris.size();
    std::vector<int> order(n);
    std::vector<V3> low(n), high(n), mid(n);
    for (int i = 0; i < n; i++) {
        order[i] = i;
        low[i] = high[i] = s.tris[i].a;
        grow(low[i], high[i], s.tris[i].b); grow(low[i], high[i], s.tris[i].c);
        mid[i] = 0.5f * (low[i] + high[i]);
    }
    const int BINS = 12;
    s.nodes.reserve(2 * n);
    s.nodes.push_back(Node{v3(0, 0, 0), v3(0, 0, 0), 0, n});
    std::vector<int> todo(1, 0);
    while (!todo.empty()) {
        int at = todo.back();
        todo.pop_back();
        int first = s.nodes[at].first, count = s.nodes[at].count;
        V3 a = v3(1e30f, 1e30f, 1e30f), b = -1.0f * a, ca = a, cb = b;
        for (int i = first; i < first + count; i++) { int t = order[i]; grow(a, b, low[t]); grow(a, b, high[t]); grow(ca, cb, mid[t]); }
        s.nodes[at].low = a; s.nodes[at].high = b;
        if (count <= 3) continue;
        V3 e = cb - ca;
        int axis = e.x > e.y && e.x > e.z ? 0 : e.y > e.z ? 1 : 2;
        float start = (&ca.x)[axis], size = (&e.x)[axis];
        int cut = first + count / 2;
        if (size > 1e-9f) {
            V3 bl[BINS], bh[BINS];
            int bn[BINS] = {0};
            for (int k = 0; k < BINS; k++) { bl[k] = v3(1e30f, 1e30f, 1e30f); bh[k] = -1.0f * bl[k]; }
            auto bin = [&](int t) { return std::min(BINS - 1, (int)(BINS * ((&mid[t].x)[axis] - start) / size)); };
            for (int i = first; i < first + count; i++) { int t = order[i], k = bin(t); bn[k]++; grow(bl[k], bh[k], low[t]); grow(bl[k], bh[k], high[t]); }
            float best = 1e30f; int best_k = -1;
            for (int k = 1; k < BINS; k++) {
                V3 la = v3(1e30f, 1e30f, 1e30f), lb = -1.0f * la, ra = la, rb = lb;
                int ln = 0, rn = 0;
                for (int m = 0; m < BINS; m++) if (bn[m]) { if (m < k) { ln += bn[m]; grow(la, lb, bl[m]); grow(la, lb, bh[m]); } else { rn += bn[m]; grow(ra, rb, bl[m]); grow(ra, rb, bh[m]); } }
                float cost = ln * area(la, lb) + rn * area(ra, rb);
                if (ln && rn && cost < best) { best = cost; best_k = k; }
            }
            if (best_k > 0) cut = (int)(std::partition(order.begin() + first, order.begin() + first + count, [&](int t) { return bin(t) < best_k; }) - order.begin());
        }
        int child = (int)s.nodes.size();
        s.nodes.push_back(Node{v3(0, 0, 0), v3(0, 0, 0), first, cut - first});
        s.nodes.push_back(Node{v3(0, 0, 0), v3(0, 0, 0), cut, first + count - cut});
        s.nodes[at].first = child; s.nodes[at].count = 0;
        todo.push_back(child); todo.push_back(child + 1);
    }
    std::vector<Tri> t2(n); std::vector<Fine> f2(n);
    for (int i = 0; i < n; i++) { t2[i] = s.tris[order[i]]; f2[i] = s.fine[order[i]]; }
    s.tris.swap(t2); s.fine.swap(f2);
}

extern "C" {
int sizes(int which) { return which == 0 ? sizeof(Look) : which == 1 ? sizeof(Light) : which == 2 ? sizeof(View) : which == 3 ? sizeof(Fine) : sizeof(Body); }
Scene* scene_new(const float* tris, const void* fine, int n, const void* bodies, int nb, const void* looks, int nl) {
    Scene* s = new Scene;
    s->tris.assign((const Tri*)tris, (const Tri*)tris + n);
    s->fine.assign((const Fine*)fine, (const Fine*)fine + n);
    s->bodies.assign((const Body*)bodies, (const Body*)bodies + nb);
    s->looks.assign((const Look*)looks, (const Look*)looks + nl);
    build(*s);
    World w = {s->tris.data(), s->fine.data(), s->nodes.data(), s->bodies.data(), s->looks.data()};
#ifdef __CUDACC__
    w = World{moved(w.tris, n), moved(w.fine, n), moved(w.nodes, s->nodes.size()), moved(w.bodies, nb), moved(w.looks, nl)};
#endif
    s->world = w;
    return s;
}
void scene_free(Scene* s) {
#ifdef __CUDACC__
    cudaFree((void*)s->world.tris); cudaFree((void*)s->world.fine); cudaFree((void*)s->world.nodes); cudaFree((void*)s->world.bodies); cudaFree((void*)s->world.looks);
#endif
    delete s;
}
int render(Scene* s, const Light* l, const View* v, float* rgb, float* depth, uint8_t* ids) {
    int n = v->w * v->h;
#ifdef __CUDACC__
    float *r, *d; uint8_t* k;
    cudaMalloc(&r, 12 * n); cudaMalloc(&d, 4 * n); cudaMalloc(&k, n);
    pixels<<<(n + 63) / 64, 64>>>(s->world, *l, *v, r, d, k);
    int error = (int)cudaDeviceSynchronize();
    cudaMemcpy(rgb, r, 12 * n, cudaMemcpyDeviceToHost); cudaMemcpy(depth, d, 4 * n, cudaMemcpyDeviceToHost); cudaMemcpy(ids, k, n, cudaMemcpyDeviceToHost);
    cudaFree(r); cudaFree(d); cudaFree(k);
    return error;
#else
    for (int i = 0; i < n; i++) pixel(s->world, *l, *v, i, rgb, depth, ids);
    return 0;
#endif
}
}
