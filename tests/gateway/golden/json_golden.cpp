// Writes doubles.txt and strings.txt of this folder: what nlohmann::json 3.11 makes of them.
//
//     g++ -O2 -std=c++17 json_golden.cpp -o json_golden && ./json_golden
//
// doubles.txt: 16 hex digits of the bits, a space, the text. strings.txt: the UTF-8 in hex, a space, the text, or
// `refused`. Half of the random doubles are those where the shortest digits that read back are others.

#include <charconv>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <functional>
#include <limits>
#include <nlohmann/json.hpp>
#include <random>
#include <string>
#include <vector>

using nlohmann::json;

static std::mt19937_64 dice(20261121);

static double from_bits(std::uint64_t bits) {
  double value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

static std::uint64_t to_bits(double value) {
  std::uint64_t bits;
  std::memcpy(&bits, &value, sizeof bits);
  return bits;
}

static bool reads_back_shorter_or_closer(double value) {
  char shortest[32];
  auto end = std::to_chars(shortest, shortest + sizeof shortest, value, std::chars_format::scientific).ptr;
  std::string ours = json(value).dump();
  double same = std::strtod(ours.c_str(), nullptr);
  std::string digits_ours, digits_shortest;
  for (char c : ours.substr(0, ours.find('e')))
    if (std::isdigit(c)) digits_ours += c;
  for (char *c = shortest; c != end && *c != 'e'; ++c)
    if (std::isdigit(*c)) digits_shortest += *c;
  digits_ours.erase(0, digits_ours.find_first_not_of('0'));
  digits_ours.erase(digits_ours.find_last_not_of('0') + 1);
  digits_shortest.erase(digits_shortest.find_last_not_of('0') + 1);
  return same == value && digits_ours != digits_shortest;
}

int main() {
  std::vector<double> doubles = {0.0, -0.0, 1.0, -1.0, 9.81, 0.1, double(0.1F), 1e15, 1e14, 123456789012345.0, 1e16,
                                 999999999999999.9, 1e-4, 1e-5, 0.00012, 1.5e300, 5e-324, 2.2250738585072014e-308,
                                 std::numeric_limits<double>::max(), std::numeric_limits<double>::infinity(),
                                 -std::numeric_limits<double>::infinity(), std::numeric_limits<double>::quiet_NaN(),
                                 9007199254740993.0, 1.0 / 3, 2.0 / 3, 3.141592653589793};
  auto add = [&](int count, std::function<double()> draw) {
    for (int i = 0; i < count; ++i) doubles.push_back(draw());
    for (int i = 0; i < count;) {
      double value = draw();
      if (std::isfinite(value) && reads_back_shorter_or_closer(value)) doubles.push_back(value), ++i;
    }
  };
  std::normal_distribution<double> normal(0, 10);
  add(400, [&] { return from_bits(dice()); });
  add(300, [&] { return normal(dice); });
  add(300, [&] { return double(float(normal(dice))); });
  add(150, [&] { return std::pow(10, std::uniform_real_distribution<double>(12, 19)(dice)); });
  add(150, [&] { return from_bits(dice() >> 12); });
  for (int exponent = -1074; exponent < 1024; exponent += 13) doubles.push_back(std::ldexp(1, exponent));
  for (int exponent = -323; exponent < 309; exponent += 5) doubles.push_back(std::strtod(("1e" + std::to_string(exponent)).c_str(), nullptr));
  for (int i = 0; i < 150; ++i) doubles.push_back(std::round(normal(dice) * 1000) / 1000);
  std::ofstream out("doubles.txt");
  for (double value : doubles) {
    char bits[17];
    std::snprintf(bits, sizeof bits, "%016llx", static_cast<unsigned long long>(to_bits(value)));
    out << bits << ' ' << json(value).dump() << '\n';
  }

  std::vector<std::string> strings = {"", "map", "caf\xc3\xa9", "\xe2\x82\xac", "\xf0\x9f\x98\x80", "a\"b\\c/d", "\x7f",
                                      "\xc2\x80", "\xe2\x80\xa8", "\xef\xbf\xbf", "\xf4\x8f\xbf\xbf", "\xed\x9f\xbf",
                                      "\xff", "\xc0\x80", "\xc3", "\xed\xa0\x80", "\xf4\x90\x80\x80", "\xe0\x80\x80", "a\x80",
                                      "\xf0\x80\x80\x80", "\xf8\x88\x80\x80\x80", "\xe2\x82"};
  for (int c = 0; c < 32; ++c) strings.push_back(std::string("a") + char(c) + "b");
  std::ofstream texts("strings.txt");
  for (const auto &string : strings) {
    for (unsigned char c : string) {
      char hex[3];
      std::snprintf(hex, sizeof hex, "%02x", c);
      texts << hex;
    }
    std::string text = "refused";
    try {
      text = json(string).dump();
    } catch (const json::exception &) {
    }
    texts << ' ' << text << '\n';
  }
}
